"""One module per data set; all yield :class:`pytest_cpas.types.Sample`."""
