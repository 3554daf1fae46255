"""The one place that imports Open3D.

Open3D's Linux wheels link to ``libusb-1.0.so.0``, which a bare machine does not have and which
takes root to install. The ``libusb-package`` wheel carries the library; once it is loaded under
its own name, the dynamic linker takes it for Open3D's.
"""

from __future__ import annotations

import ctypes
import importlib
import sys
from types import ModuleType


def import_open3d() -> ModuleType:
    """Import and return :mod:`open3d`.

    Raises :class:`ImportError` that says what to install when it cannot be had.
    """
    if sys.platform == "linux" and "open3d" not in sys.modules:
        try:
            ctypes.CDLL("libusb-1.0.so.0")
        except OSError:
            _load_packaged_libusb()
    try:
        return importlib.import_module("open3d")
    except ImportError as error:
        raise ImportError(
            f"Open3D cannot be imported ({error}). Rendering and ray casting need it: "
            "pip install 'pytest-cpas[open3d]'. If it is a shared library that is missing, "
            "install the system package that has it (Debian: libusb-1.0-0 libgl1 libgomp1)."
        ) from error


def _load_packaged_libusb() -> None:
    try:
        libusb_package = importlib.import_module("libusb_package")
    except ImportError:
        return  # Open3D's own import error then names the missing library
    path = libusb_package.get_library_path()
    if path is not None:
        ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
