"""The stable region of two parameters: its boundary, its picture, and published conditions for comparison."""
