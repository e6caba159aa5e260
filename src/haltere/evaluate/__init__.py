"""Errors against a reference, consistency of the stated uncertainty, and health. It reads flights and solutions and changes neither."""
