"""`python -m jaxvol` is `jaxvol`."""

from jaxvol.cli import main

main()
