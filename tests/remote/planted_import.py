"""What happens while a module is imported, by what a variable says."""

import os
import sys

kind = os.environ["PLANTED"]
if kind == "raises":
    raise ImportError("libcudart.so.9.0: cannot open shared object file")
if kind == "exits":
    sys.exit(3)
if kind == "dies":
    os._exit(3)
