"""One file a sensor: h, H, R, its gate and its start, continue and stop conditions, and the dispatch.

It does not decide when a sample is due.
"""
