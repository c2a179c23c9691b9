"""The command `jaxvol`. Only this module sets JAX options; each command is imported only when it is called.

Exit status: 0 fine, 1 a check failed, 2 bad input (one line on stderr; JAXVOL_TRACEBACK=1 shows where it came from).
"""

import importlib
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import typer

import jaxvol

# A command is the function of that name in jaxvol/commands/<name>.py; one line here registers it.
COMMANDS = {
    "render": "Render a scene file to EXR, PNG and JSON.",
    "compare": "Print the error of one EXR picture against another as JSON.",
    "bake": "Bake light onto surfaces and into probes: EXR lightmap, GLB, .npz.",
    "tabulate": "Compute or verify tables of impulse responses.",
    "benchmark": "Run time against error: scenes x methods x settings, with tables and plots.",
    "stress": "Random and extreme scenes through every method, checked by what must hold.",
    "fit": "Run the fits behind the tables; CSV and figures.",
    "schema": "Print the JSON schema of scene files.",
}


def main(*, arguments: Sequence[str] | None = None) -> None:
    """Run the command line; ends the process with the exit status."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    command = typer.main.get_command(_assemble(arguments))
    try:
        command(args=arguments, prog_name="jaxvol")
    except (ValueError, OSError, MemoryError) as error:
        if os.environ.get("JAXVOL_TRACEBACK"):
            raise
        print(f"error: {_one_line(error)}", file=sys.stderr)
        sys.exit(2)


def _assemble(arguments: Sequence[str]) -> typer.Typer:
    """All commands by name and help; only the called one with its code."""
    app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)
    app.callback()(_about)
    called = next((word for word in arguments if not word.startswith("-")), None)
    for name, help_text in COMMANDS.items():
        if name == called:
            configure_jax()
            module = importlib.import_module(f"jaxvol.commands.{name}")
            app.command(name)(getattr(module, name))
        else:
            app.command(name, help=help_text)(_placeholder())
    return app


def _print_version(asked: bool) -> None:
    if asked:
        print(f"jaxvol {jaxvol.__version__}")
        raise typer.Exit()


def _about(
    version: bool = typer.Option(False, "--version", help="Print the version.", is_eager=True, callback=_print_version),
) -> None:
    """Light in fog, smoke, clouds and translucent solids."""


def _placeholder() -> Callable[[], None]:
    def command() -> None:
        """A command that is listed in the help but not called."""

    return command


def configure_jax() -> None:
    """Quiet logs and a compilation cache that survives the process, and serves those that it starts.

    By environment variables, which jax reads when it is imported; where they are set already, they stay.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")  # hundreds of small programs make seconds
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxvol"
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError:
        return  # a home that cannot be written: compile every time
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(cache)


def _one_line(error: BaseException) -> str:
    if isinstance(error, MemoryError):
        return f"not enough memory ({error})"
    return " ".join(str(error).split()) or type(error).__name__
