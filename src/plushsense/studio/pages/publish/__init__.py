"""The page *Publish*."""

from plushsense.studio.app.words import PageTexts

TEXTS = PageTexts(
    name="Publish",
    title="Publish",
    help=(
        "This page makes a package of a data set that others can use. Names, dates and free texts can be replaced or "
        "left out.\n"
        "Fill in title, creators, licence and consent, and press the button. Nothing leaves this computer until you "
        "pass the package on yourself."
    ),
    tour=(
        "Here a data set becomes a package for other researchers, without names. This was the last page: end the "
        "tour, and press the button on the home page."
    ),
)
