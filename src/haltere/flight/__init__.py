"""A flight as data: schema, log, flight folder, checks at the door, configuration and solution.

It holds no kernels and no file formats of others.
"""
