"""The command line, one file a verb. It parses, calls and prints; heavy imports are made inside the verbs."""
