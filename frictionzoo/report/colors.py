"""Colours of curves, the same in every figure and page."""

MEASURED, TEXT, SOFT, GRID = "#000000", "#3d4450", "#7d8794", "#dfe3e8"
PAPER = "#ffffff"  # background of text over curves
MODEL, BASELINE, BEST, TRAIN = "#0072B2", "#E69F00", "#D00000", "#009E73"
# Okabe and Ito (2008), legible for colour-blind readers; without black (measured curves) and yellow (faint on paper).
RUNS = (MODEL, "#D55E00", TRAIN, "#CC79A7", "#56B4E9", BASELINE)
JOINTS = (MODEL, TRAIN, "#CC79A7", "#56B4E9", BASELINE, MEASURED, "#F0E442")
BAND = 0.2  # opacity of a band around a curve


def fade(color: str) -> str:
    """Return the transparent colour of a band around a curve of this colour."""
    red, green, blue = (int(color[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{BAND})"


_PALE = {
    MEASURED: "#f4f4f4",
    MODEL: "#56B4E9",
    "#56B4E9": "#B5E0FF",
    BEST: "#ff6b6b",
    TEXT: "#c3c9d2",
    GRID: "#323945",
    PAPER: "#181c23",
}
# Replacement of each colour on a dark page; the other colours are legible on both.
DARK = _PALE | {fade(color): fade(pale) for color, pale in _PALE.items()}
