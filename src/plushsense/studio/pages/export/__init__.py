"""The page *Export*."""

from plushsense.studio.app.words import PageTexts

TEXTS = PageTexts(
    name="Export",
    title="Export",
    help=(
        "This page writes the program for the toy's chip: a folder that a firmware engineer builds into the toy. "
        "Choose a network and press Export.\n"
        "Check compares the program with the studio, number by number."
    ),
    tour="Here a network becomes a program for the toy's chip. Firmware engineers take it from here.",
)
