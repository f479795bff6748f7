"""Registration methods, one file each, and the surfaces of clouds that they define."""
