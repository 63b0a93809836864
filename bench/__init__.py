"""Benchmarks and reproductions; each module is a command."""
