"""The picture of the house in docs/ is drawn from the code as it stands."""

import architecture_picture


def test_the_picture_is_current():
    """Otherwise: python tests/architecture_picture.py."""
    picture = architecture_picture.PICTURE.read_text(encoding="utf-8")
    assert picture == architecture_picture.draw() + "\n"
