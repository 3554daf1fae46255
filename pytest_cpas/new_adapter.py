"""``pytest-cpas new-adapter``: a method that runs at once, to be filled in."""

from __future__ import annotations

import importlib.util
import keyword
import re
from importlib.resources import files
from pathlib import Path
from string import Template

from pytest_cpas.registry import registered
from pytest_cpas.types import ToldError

_TEMPLATES = {
    "{module}.py": "method.py.template",
    "test_{module}.py": "test_method.py.template",
    "{name}.known.toml": "known.toml.template",
}

#: The same of a method in another interpreter.
_ELSEWHERE = {
    "{module}.py": "method_elsewhere.py.template",
    "cpas-methods.toml": "cpas-methods.toml.template",
    "{name}.known.toml": "known.toml.template",
}


class NewAdapterError(ToldError):
    """A name that cannot be used, or files that are in the way."""


def new_adapter(name: str, folder: Path, interpreter: str | None = None) -> tuple[list[Path], str]:
    """Write the skeleton of a method ``name`` into ``folder``, which is made if need be.

    ``interpreter``: the version of the one that it runs in, such as "3.6"; None for this one.

    Returns the files and the pytest options that run it from there. Raises
    :class:`NewAdapterError`, with nothing written, for a name that is no module's or belongs to
    another one, and if a file exists.
    """
    if not re.fullmatch(r"[a-z][a-z0-9]*([-_][a-z0-9]+)*", name):
        raise NewAdapterError(
            f"name {name!r}: expected small letters and digits, in parts joined by '-', such as"
            " my-method; it names a module, a class and a folder of golden tables"
        )
    if name in {entry.name for entry in registered("method")}:
        raise NewAdapterError(
            f"name {name!r}: a method of that name is registered (pytest --cpas-list); a port of"
            " it gets a name of its own, and its info.name once it shall be compared with the"
            " golden table of that one"
        )
    version = re.fullmatch(r"3\.(\d+)", interpreter or "3.6")
    if version is None or int(version[1]) < 6:
        raise NewAdapterError(
            f"--for-interpreter {interpreter}: expected a version of Python, 3.6 or newer, such as"
            " 3.8"
        )
    module = name.replace("-", "_")
    paths = {
        folder / path.format(name=name, module=module): template
        for path, template in (_ELSEWHERE if interpreter else _TEMPLATES).items()
    }
    existing = [str(path) for path in paths if path.exists()]
    if existing:
        raise NewAdapterError(f"{', '.join(existing)}: there already; nothing was written")
    if keyword.iskeyword(module) or importlib.util.find_spec(module) is not None:
        raise NewAdapterError(
            f"name {name!r}: python has {module} already, as a word of its own or as a module that"
            " is installed; take another one"
        )
    class_name = "".join(part.capitalize() for part in module.split("_"))
    method = name if interpreter else f"{module}:{class_name}"
    options = f"--cpas-method={method} --cpas-dataset=synthetic-handheld"
    values = {"name": name, "module": module, "class_name": class_name, "pytest_options": options}
    values["version"] = interpreter or ""
    own_test = f"test_{module}.py::test_contract"
    values["shown_by"] = "a test of yours that shows it" if interpreter else own_test
    folder.mkdir(parents=True, exist_ok=True)
    for path, template in paths.items():
        text = files("pytest_cpas").joinpath("adapter_template", template).read_text("utf-8")
        with path.open("x", encoding="utf-8", newline="\n") as file:
            file.write(Template(text).substitute(values))
    return list(paths), options
