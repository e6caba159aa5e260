"""Diagnosis: which sensor fails, since when and by how much, and what the filter then does about it. It reads no log and fuses nothing."""
