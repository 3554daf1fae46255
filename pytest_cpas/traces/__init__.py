"""Traces of predictions, value by value, and the parity of two codes."""
