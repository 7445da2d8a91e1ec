"""Commands of measuring and acting."""
