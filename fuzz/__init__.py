"""Fuzzing of every reader of a file from outside: mutated files in child processes with limits."""
