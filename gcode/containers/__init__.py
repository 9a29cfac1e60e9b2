"""Containers of G-code: binary G-code and sliced 3MF packages."""
