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


def test_inferred_sets_know_free_choice_and_idleness() -> None:
    found = GestureSet.infer(["Shake", "Custom", "At Rest", "Shake"])
    assert found.labels == ("At Rest", "Custom", "Shake")
    assert [g.free_choice for g in found.gestures] == [False, True, False]
    assert [g.idle for g in found.gestures] == [True, False, False]
    assert GestureSet.from_dict(found.to_dict()) == found


def test_subset_keeps_the_order_of_the_set() -> None:
    assert load_gestures("plush-18").subset(["Tail pull", "At rest"]).labels == ("At rest", "Tail pull")


def test_similar_gestures_are_merged_by_family_affect_or_a_set() -> None:
    plush = load_gestures("plush-18")
    family, affect, named = (plush.merged_by(name) for name in ("family", "affect", "plush-13"))
    assert len(family) == 11 and family.get("Tail hit 2").label == "Tail hit" and family.get("Tail hit 1").energetic
    assert affect.labels == ("neutral", "positive", "negative") and affect.get("Hold strong").affect == "positive"
    assert not affect.get("At rest").idle, "holding it in the hands is no idleness"
    # The clusters of the paper's section 4.3, and nothing else; affects and the other gestures are those of Table 2.
    assert named.labels[5] == "Head stroke" and [len(g.labels) for g in named.gestures if g.labels] == [2, 2, 4]
    assert [len(group) for group in plush.groups_of(named) if len(group) > 1] == [2, 2, 4]
    for merged in (family, affect, named):
        for gesture in plush.gestures:
            found = merged.get(gesture.label)
            assert found.affect == gesture.affect and (found.labels or found.idle == gesture.idle)
    plain = GestureSet("x", (Gesture("A"), Gesture("B"), Gesture("C", "positive")))
    assert plain.merged_by("affect").labels == ("A", "B", "positive"), "what is unknown is not merged"
    with pytest.raises(GestureError, match="have no affect"):
        plain.subset(["A", "B"]).merged_by("affect")
    with pytest.raises(GestureError, match="accepted are family, affect, plush-13, and .* Did you mean 'family'"):
        plush.merged_by("familiy")
    with pytest.raises(GestureError, match="There is no gesture set file"):
        plush.merged_by("none.toml")


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
