"""A scene in the browser: sliders, and what they do; README.md beside this file says how."""
