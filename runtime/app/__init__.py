"""The interactive page in the browser: sliders and results."""
