"""Adapters of methods, one module per method; they know :mod:`pytest_cpas.adapting` alone."""
