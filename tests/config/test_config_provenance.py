"""The hash of the deciding code: what it covers, and what does not count."""

from __future__ import annotations

from pathlib import Path

import pytest

from bikeped.config.provenance import DECIDING_CODE, MEASURING_CODE, code_hash

SOURCE = '''"""A module."""
LIMIT = 3  # metres


class Rule:
    """A rule."""

    def fires(self, distance_m: float) -> bool:
        """Whether it fires."""
        near = distance_m < LIMIT
        return near and f"{distance_m:.2f}" != "0.00"
'''


def hash_of(folder: Path, source: str, name: str = "rule.py") -> str:
    """`code_hash` of a package `rules` with one module, in a folder of its own."""
    package = folder / str(len(list(folder.iterdir()))) / "rules"
    package.mkdir(parents=True)
    (package / name).write_text(source)
    return code_hash(("rules",), package.parent)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("  # metres", "  # feet?"),
        ('"""A module."""\n', ""),
        ('    """A rule."""\n\n', ""),
        ('"""Whether it fires."""', '"""True when both are near."""'),
        ("\n\n\nclass", "\n\nclass"),
        ("distance_m < LIMIT", "(distance_m\n            < LIMIT)"),
        ('"0.00"', "'0.00'"),
    ],
)
def test_comments_docstrings_and_layout_do_not_count(tmp_path, old, new):
    assert old in SOURCE
    assert hash_of(tmp_path, SOURCE.replace(old, new)) == hash_of(tmp_path, SOURCE)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("LIMIT = 3", "LIMIT = 3.0"),
        ("LIMIT = 3", "LIMIT = -3"),
        ("<", "<="),
        ("near and", "near or"),
        (":.2f", ":.3f"),
        ('!= "0.00"', '!= "0.0"'),
        ("return near", "return not near"),
        ("def fires", "def fire"),
        ("-> bool", "-> object"),
    ],
)
def test_whatever_is_executed_counts(tmp_path, old, new):
    assert old in SOURCE
    assert hash_of(tmp_path, SOURCE.replace(old, new)) != hash_of(tmp_path, SOURCE)


def test_names_of_modules_and_statements_between_them_count(tmp_path):
    assert hash_of(tmp_path, SOURCE, "a.py") != hash_of(tmp_path, SOURCE, "b.py")


def test_the_hash_does_not_depend_on_the_version_of_python(tmp_path):
    """Of a source with syntax whose tree has got new fields since 3.10; made with 3.10 and 3.13."""
    assert hash_of(tmp_path, SOURCE) == (
        "d36697580aadf1e39fb80bb4d5dbba19c3bc8c2bd2a91f0e2fda19ee049adbf3"
    )


def test_all_code_that_decides_on_the_pole_is_covered():
    root = Path(__file__).parents[2] / "bikeped"
    for part in (*DECIDING_CODE, *MEASURING_CODE):
        assert (root / part).is_dir() or (root / f"{part}.py").is_file(), part
    needed = {"config/build", "pipeline/track_and_decide"}
    assert needed <= set(DECIDING_CODE)
    assert {"decision", "geometry", "tracking"} <= set(DECIDING_CODE)
    assert code_hash() != code_hash((*DECIDING_CODE, *MEASURING_CODE))
