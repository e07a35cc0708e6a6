"""Sizes around a panel of a page, in inches: labels of one font and a few digits fit into them."""

WIDTH_IN = 10.4
"""Of a page's figures."""
PICTURE_WIDTH_IN = 6.6
"""Of a figure over a camera's picture."""
LEFT_IN = 0.74
"""For "-0.025", a label across it, and a gap between them."""
RIGHT_IN = 0.08
BOTTOM_IN = 0.42
LEGEND_IN = 0.27
TITLE_IN = 0.21
TOP_IN = 0.06
"""Above a panel without a title."""
GAP_IN = 0.13
"""Between panels without numbers."""
BARE_GAP_IN = 0.5
"""Between columns of which the first alone is labelled."""
TICK_LABELS_IN = 0.20
Y_LABEL_IN = 0.58
"""From the axis to the middle of its label."""
X_LABEL_IN = 0.24
