"""jaxvol: light in fog, smoke, clouds and translucent solids, by four fast methods and one unbiased reference."""

import time

STARTED = time.perf_counter()  # when this process first imported jaxvol: the time to the first picture counts from here

__version__ = "0.1.0"
