"""The page *Record*."""

from plushsense.studio.app.words import PageTexts

TEXTS = PageTexts(
    name="Record",
    title="Record",
    help=(
        "Write the code of the person (such as S01, never a name), choose the toy, and begin the session.\n"
        "The page then shows one gesture after another. The space bar or the large button starts a countdown and "
        "stops the recording; r makes the last one again, s skips a gesture, b goes back, p pauses.\n"
        "Everything is saved at once. If the computer or the browser stops, open this page again and continue."
    ),
    tour=(
        "Here you record. The page shows a gesture, the child makes it, and the space bar starts and stops each "
        "recording."
    ),
)
