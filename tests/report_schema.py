"""The schema of a report, which every document of the tests has to follow."""

import json
from pathlib import Path

from jsonschema import Draft202012Validator

import pytest_cpas.report

VALIDATOR = Draft202012Validator(
    json.loads(Path(pytest_cpas.report.__file__).with_name("schema.json").read_text())
)


def follow_schema(content: dict) -> None:
    """Raise what is wrong with a document."""
    VALIDATOR.validate(content)
