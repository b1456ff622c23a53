import pytest

from plushsense.core.errors import MissingExtraError, need


def test_a_missing_package_names_the_install_command() -> None:
    with pytest.raises(MissingExtraError, match=r"pip install 'plushsense\[cluster\]'"):
        need("no_such_package_at_all", "cluster")
