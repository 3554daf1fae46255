"""The one door for bytes that others wrote: every damage is an error that names the file."""
