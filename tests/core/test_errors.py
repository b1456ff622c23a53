import json
import pickle

from plushsense.core import errors
from plushsense.core.errors import BadInput, nearest, printable


def test_every_exception_is_in_the_drawn_tree() -> None:
    drawn = errors.__doc__ or ""
    for name, kind in vars(errors).items():
        if isinstance(kind, type) and issubclass(kind, Exception) and not issubclass(kind, Warning):
            assert name in drawn
            assert issubclass(kind, errors.PlushSenseError)


def test_nearest_suggests_only_what_is_close() -> None:
    assert nearest("strem", ("stream", "causal", "mirror")) == " Did you mean 'stream'?"
    assert nearest("zzz", ("stream", "causal")) == ""


def test_control_characters_are_escaped_in_sentences_and_valid_in_json() -> None:
    hostile = "a\x1b[2J\x9b1m\rb\n\u202eplushsense: all is well"
    assert str(BadInput(hostile)) == r"a\u001b[2J\u009b1m\u000db\u000a\u202eplushsense: all is well"
    assert str(pickle.loads(pickle.dumps(BadInput(hostile)))) == str(BadInput(hostile))
    assert printable("a\n\tä 雨", lines=True) == "a\n\tä 雨"
    line = json.dumps(hostile, ensure_ascii=False)
    assert json.loads(printable(line, lines=True)) == hostile and "\x9b" not in printable(line)
