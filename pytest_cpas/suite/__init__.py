"""The test modules that ship with the plugin; they parametrise the checks and nothing else."""
