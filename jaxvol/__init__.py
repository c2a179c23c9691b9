"""jaxvol: light in fog, smoke, clouds and translucent solids, by four fast methods and one unbiased reference."""

__version__ = "0.1.0"
