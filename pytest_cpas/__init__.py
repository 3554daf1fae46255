"""A conformance and regression harness for RGB-D categorical pose and shape methods."""
