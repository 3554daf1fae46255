"""Reading the pickles that the field exchanges without running what is in them."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

from pytest_cpas.types import ContractError, DataError

# What numpy's arrays, scalars and dtypes name when they are pickled, by numpy 1 and numpy 2.
_ALLOWED = frozenset(
    (module, name)
    for core in ("numpy.core", "numpy._core")
    for module, name in (
        (f"{core}.multiarray", "_reconstruct"),
        (f"{core}.multiarray", "scalar"),
        (f"{core}.numeric", "_frombuffer"),
        ("numpy", "ndarray"),
        ("numpy", "dtype"),
    )
)


class _NumpyUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _ALLOWED:
            return super().find_class(module.replace("numpy.core", "numpy._core"), name)
        raise DataError(
            f"the pickle names {module}.{name}, and only plain values and numpy arrays are read,"
            " because loading anything else could run code. If you trust where it comes from,"
            " load it yourself and save the arrays again"
        )


def load_numpy_pickle(path: Path) -> dict[str, Any]:
    """Read a pickled dict of builtins and numpy arrays; nothing else in it is ever called.

    Raises :class:`DataError` naming the file when it names any other global, is truncated or
    damaged, or holds no dict; :class:`FileNotFoundError` when it is not there.
    """
    with path.open("rb") as file:
        try:
            # latin1 is how Python 3 reads the array bytes of a Python 2 pickle
            content = _NumpyUnpickler(file, encoding="latin1").load()
        except ContractError as error:
            raise DataError(f"{path}: {error}") from None
        except Exception as error:  # a damaged pickle can raise nearly anything
            raise DataError(
                f"{path}: not a readable pickle ({type(error).__name__}: {error}); is the file"
                " truncated? Fetch it again"
            ) from error
    if not isinstance(content, dict):
        raise DataError(f"{path}: holds a {type(content).__name__}, expected a dict of arrays")
    return content
