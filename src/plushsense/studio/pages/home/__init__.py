"""The page *Home*."""

from plushsense.studio.app.words import PageTexts

TEXTS = PageTexts(
    name="Home",
    title="Home",
    help=(
        "Home shows the next step in the box at the top. Press its button, and you cannot go wrong.\n"
        "Below are your data sets, recorded sessions and trained networks. The menu with three dots renames, saves "
        "or discards one; what is discarded can be restored.\n"
        "On the right you choose the toy. A virtual toy is always there to practise with; everything made with it is "
        "marked as a simulation.\n"
        "All data stay on this computer."
    ),
    tour=(
        "Start here. The box says what to do next, and one button does it. Below are your data sets and networks; on "
        "the right you choose the toy."
    ),
)
