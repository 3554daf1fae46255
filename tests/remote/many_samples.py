"""A data set with a sample for each fault that a worker survives, and one before each."""

from pathlib import Path

import planted_methods
import tiny

from pytest_cpas.types import SampleRef


class Many(tiny.Tiny):
    def __init__(self, data_dir: Path | None) -> None:
        self.samples = [
            SampleRef(id=f"s/{index:04d}", category="mug", scene="s")
            for index in range(2 * len(planted_methods.SURVIVED))
        ]
