"""docs/benchmarks.md is made of docs/benchmarks.json, and of nothing else."""

import importlib.util
import json
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[2]


def all_benchmarks() -> ModuleType:
    spec = importlib.util.spec_from_file_location("bench_all", ROOT / "benchmarks" / "all.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_holds_the_figures_and_nothing_pasted_by_hand() -> None:
    sections = json.loads((ROOT / "docs" / "benchmarks.json").read_text())
    assert (ROOT / "docs" / "benchmarks.md").read_text() == all_benchmarks().page(sections)


def test_every_section_says_where_it_was_measured() -> None:
    for name, section in json.loads((ROOT / "docs" / "benchmarks.json").read_text()).items():
        assert (ROOT / "benchmarks" / f"{name}.py").is_file(), name
        assert "processors" in section["machine"]
        assert "swath" in section["versions"]
