"""pytest options and hooks; imports nothing heavy."""
