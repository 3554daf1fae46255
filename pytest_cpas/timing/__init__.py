"""How long a method takes: measured with pytest-benchmark, judged by ratios alone."""
