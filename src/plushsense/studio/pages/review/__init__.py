"""The page *Review*."""

from plushsense.studio.app.words import PageTexts

TEXTS = PageTexts(
    name="Review",
    title="Review",
    help=(
        "Here you see whether each recording is good. Those to decide come first.\n"
        "The dotted line is the suggested start of the gesture. Enter accepts it and shows the next recording; a "
        "click into the plot sets another start; x leaves a recording out.\n"
        "The recordings themselves never change, and every decision can be undone."
    ),
    tour="Here you look through the recordings. Enter accepts, x leaves one out, and everything can be undone.",
)
