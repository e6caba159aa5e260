"""The version, written once: the build reads it from here. It holds nothing else."""

__version__ = "0.1.0.dev0"
