"""Stillpath: print compensation for G-code.

The rooms of the package lie in the checkout's root; here are links to them, so that all of it has
one import name, ``stillpath``.
"""
