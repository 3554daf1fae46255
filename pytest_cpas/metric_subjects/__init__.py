"""Adapters of metric implementations: our own and published ones, with what they violate."""
