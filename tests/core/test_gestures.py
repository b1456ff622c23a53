import pytest

from plushsense.core.errors import GestureError
from plushsense.core.gestures import Gesture, GestureSet, load_gestures


def test_plush_18_is_table_2_of_the_paper() -> None:
    gestures = load_gestures("plush-18")
    assert len(gestures) == 18
    assert gestures.labels == tuple(sorted(gestures.labels)), "the class order of the paper is alphabetical"
    assert gestures.labels[0] == "At rest"
    assert gestures.gestures[0].nobody
    by_affect = {a: [g.label for g in gestures.gestures if g.affect == a] for a in ("neutral", "negative")}
    assert by_affect["neutral"] == ["At rest", "Hold in hands"]
    assert by_affect["negative"] == ["Tail hit 1", "Tail hit 2", "Tail pull"]
    assert gestures.get("Tail tap 1").family == gestures.get("Tail tap 2").family == "Tail tap"


def test_labels_are_found_as_file_names_spell_them() -> None:
    gestures = load_gestures("plush-18")
    assert gestures.get("tail_tap 1").label == "Tail tap 1"
    with pytest.raises(GestureError, match=r"Did you mean 'Tail pull'\?"):
        gestures.get("Tail pul")


def test_inferred_sets_know_free_choice() -> None:
    found = GestureSet.infer(["Shake", "Custom", "At Rest", "Shake"])
    assert found.labels == ("At Rest", "Custom", "Shake")
    assert [g.free_choice for g in found.gestures] == [False, True, False]
    assert GestureSet.from_dict(found.to_dict()) == found


def test_subset_keeps_the_order_of_the_set() -> None:
    assert load_gestures("plush-18").subset(["Tail pull", "At rest"]).labels == ("At rest", "Tail pull")


def test_wrong_sets_are_refused() -> None:
    with pytest.raises(GestureError, match=r"affect 'postive'.*Did you mean 'positive'"):
        Gesture("x", affect="postive")
    with pytest.raises(GestureError, match="twice"):
        GestureSet("s", (Gesture("Tail tap"), Gesture("tail_tap")))


def test_spellings_of_one_label_are_one_gesture() -> None:
    found = GestureSet.infer(["tail_tap", "Tail Tap", "Shake", "tail tap"])
    assert found.labels == ("Shake", "tail_tap")


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ({"label": 5}, "gestures.0..label is 5: accepted is text"),
        ({"label": "a", "nobody": "no"}, "nobody is 'no'"),
        ("a", "table"),
    ],
)
def test_a_gesture_of_the_wrong_type_is_refused(entry: object, said: str) -> None:
    with pytest.raises(GestureError, match=said):
        GestureSet.from_dict({"name": "own", "gestures": [entry]})
