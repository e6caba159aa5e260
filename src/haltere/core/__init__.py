"""Vectors, rotations, earth, gravity and atmosphere, as kernels on tuples. It knows no sensor, no filter and no drone."""
