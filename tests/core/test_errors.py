from plushsense.core import errors
from plushsense.core.errors import nearest


def test_every_exception_is_in_the_drawn_tree() -> None:
    drawn = errors.__doc__ or ""
    for name, kind in vars(errors).items():
        if isinstance(kind, type) and issubclass(kind, Exception):
            assert name in drawn
            assert issubclass(kind, errors.PlushSenseError)


def test_nearest_suggests_only_what_is_close() -> None:
    assert nearest("strem", ("stream", "causal", "mirror")) == " Did you mean 'stream'?"
    assert nearest("zzz", ("stream", "causal")) == ""
