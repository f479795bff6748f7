"""Nearest-neighbour search: the interface, and trees and brute force behind it."""
