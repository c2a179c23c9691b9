"""Stress: random and extreme scenes through every method, checked by what must hold whatever the scene is.

`scenes` draws scenes of few shapes (so that compilations are shared) with floats from all over their ranges; `extremes`
lists scenes on purpose; `checks` says what must hold; `driver` runs them, goes on where it was stopped, and counts.
"""
