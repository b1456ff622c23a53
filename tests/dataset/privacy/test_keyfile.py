import os
from pathlib import Path

import pytest

from plushsense.core.errors import DatasetError
from plushsense.dataset.privacy.pseudonyms import extend_key, read_key, write_key


def test_codes_are_new_each_time_and_shifts_far(tmp_path: Path) -> None:
    people = [f"P{n}" for n in range(300)]
    a, b = extend_key({}, people), extend_key({}, people)
    assert not {p.code for p in a.values()} & set(people)
    assert len({p.code for p in a.values()}) == 300
    assert sum(a[p].code == b[p].code for p in people) < 5, "nothing of a code comes from the name"
    assert all(120 * 365 <= p.shift_s / 86_400 <= 220 * 365 + 1 for p in a.values())
    assert extend_key({}, ["none"])["none"].code == "none"
    path = tmp_path / "key.csv"
    write_key(path, a)
    assert read_key(path) == a
    write_key(path, extend_key(read_key(path), ["new, one"]))
    assert {k: v for k, v in read_key(path).items() if k in a} == a
    assert "new, one" in read_key(path)
    assert [p.name for p in tmp_path.iterdir()] == ["key.csv"]
    if os.name == "posix":
        assert path.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize(
    "text", ["", "x", "original,code\n", "original,code,shift_s\n,S,1\n", "original,code,shift_s\na,S,x\n"]
)
def test_what_is_no_key_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "key.csv"
    path.write_text(text)
    with pytest.raises(DatasetError):
        read_key(path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(DatasetError, match="cannot be read"):
        read_key(path)
