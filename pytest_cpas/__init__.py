"""A conformance and regression harness for RGB-D categorical pose and shape methods.

Nothing in this module is asserted, and PYTEST_DONT_REWRITE says so: pytest would warn that it was
imported before pytest, as ``pytest-cpas merge`` does, and fail where warnings are errors.
"""
