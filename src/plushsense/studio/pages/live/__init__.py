"""The page *Live*."""

from plushsense.studio.app.words import PageTexts

TEXTS = PageTexts(
    name="Live",
    title="Live",
    help=(
        "Choose the toy and a network, and press Start. The face and the large words show what the network "
        "recognises now; the time line shows the last minute.\n"
        "The log can be saved and printed."
    ),
    tour=("Here you watch it work: touch the toy, and the page shows what was recognised and how the toy answers."),
)
