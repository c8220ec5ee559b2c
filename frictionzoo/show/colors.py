"""The colours of curves, the same on every figure and page."""

MODEL, BASELINE, BEST = "#0072B2", "#E69F00", "#D00000"
JOINTS = (
    MODEL,
    "#009E73",
    "#CC79A7",
    "#56B4E9",
    "#E69F00",
    "#000000",
    "#F0E442",
)  # Okabe and Ito (2008), legible to the colour-blind
