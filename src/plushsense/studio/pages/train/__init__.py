"""The page *Train*."""

from plushsense.studio.app.words import PageTexts

TEXTS = PageTexts(
    name="Train",
    title="Train",
    help=(
        "Choose a data set and press the recommended button. The computer learns the gestures and then tries the "
        "network on people it did not learn from.\n"
        "The result says in words how many touches it reads, and how sure that figure is. More people help most.\n"
        "You may close the page meanwhile; the work goes on."
    ),
    tour=(
        "Here the computer learns to recognise the gestures. One button makes a network, and the page says in words "
        "how well it recognises those of people it was not trained on."
    ),
)
