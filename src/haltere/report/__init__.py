"""One self-contained page about a solution, and how it looks. It computes no results: it shows those of evaluate."""
