"""Benchmarks: each is a script with its command in its docstring."""
