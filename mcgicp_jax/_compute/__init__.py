"""How a program is run: concrete or traced arrays, blocks of rows, threads, caches, lazy values."""
