"""What the paper prints of its own real-time protocol (section 4.6), to stand beside ours."""

from __future__ import annotations

from dataclasses import dataclass

SOURCE = (
    "The paper, section 4.6: five new people, 17 gestures, three times each, with the real toy. Times were taken by "
    "hand, when the output first was stable (± 0.3 s). It gives most figures as ranges or approximations (here a dash "
    "where it gives none), and it proposes the hybrid without building it."
)


@dataclass(frozen=True)
class Printed:
    """A cell group as printed: how often it answered, after how many seconds, at which likelihood; "" for nothing.

    ``reaction_s`` (low, high) is the same to draw.
    """

    activation: str = ""
    reaction: str = ""
    likelihood: str = ""
    reaction_s: tuple[float, float] | None = None


PAPER: dict[tuple[str, str], Printed] = {
    ("broad", "rules"): Printed("≈ 90 %", "≈ 3 s", "", (3.0, 3.0)),
    ("broad", "cnn"): Printed("“consistently”", "2.0–2.2 s", "", (2.0, 2.2)),
    ("fine", "rules"): Printed("≈ 6 %"),
    ("fine", "cnn"): Printed("all trials", "2.3–2.4 s", "0.75–0.88, up to 0.98", (2.3, 2.4)),
    ("energetic", "rules"): Printed("all trials", "0.1–0.2 s", "", (0.1, 0.2)),
    ("energetic", "cnn"): Printed("“reliably”", "2.0–2.5 s", "more variable", (2.0, 2.5)),
    ("neutral", "rules"): Printed("none: not processed"),
    ("neutral", "cnn"): Printed("“consistently”", "≈ 2.4 s", "≈ 0.83", (2.4, 2.4)),
}
CONFUSED = (
    "The paper's network took about 13 % of the Tail scratches for Tail taps, and no other fine scratch for something "
    "of another family."
)
"""Of the fine gestures, in the words "only within the same gesture family"; by ours a scratch and a tap are two."""
