"""The command line: `mcgicp --help` lists the commands, which live in `mcgicp_jax._cli`."""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import sys
import warnings
from collections.abc import Callable, Sequence

import jax
import platformdirs
import tyro

from mcgicp_jax import __version__
from mcgicp_jax._cli.batch import batch
from mcgicp_jax._cli.multiway import multiway
from mcgicp_jax._cli.odometry import odometry
from mcgicp_jax._cli.options import with_flags
from mcgicp_jax._cli.register import compare, demo, register
from mcgicp_jax._compute.messages import reason_of
from mcgicp_jax._compute.programs import LOGGER


def main(args: Sequence[str] | None = None) -> int:
    """Run a command and return the exit code: 0, 1 if a registration did not converge, 2 for invalid input."""
    try:
        try:
            return _run(sys.argv[1:] if args is None else args)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        # The reader of the output, such as `head`, has ended. Python flushes the output once more when it exits.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _run(args: Sequence[str]) -> int:
    if list(args) == ["--version"]:
        print(f"mcgicp {__version__}")
        return 0
    # Cache compiled programs on disk, in JAX's cache folder if one is set; do without if none can be written.
    with contextlib.suppress(OSError):
        if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
            folder = platformdirs.user_cache_path("mcgicp_jax", ensure_exists=True)
            jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    # Exclude imported modules from garbage collection, which took a tenth of the time of a short command.
    gc.freeze()
    commands: tuple[Callable[..., int], ...] = (demo, register, compare, odometry, multiway, batch)
    # Show log records of the package and warnings as lines of stderr.
    handler, level = logging.StreamHandler(), LOGGER.level
    handler.setFormatter(logging.Formatter("mcgicp: %(message)s"))
    LOGGER.addHandler(handler)
    LOGGER.setLevel(logging.INFO)
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: print(f"mcgicp: {with_flags(str(message))}", file=sys.stderr)
        try:
            return tyro.extras.subcommand_cli_from_dict(
                {command.__name__: command for command in commands},
                prog="mcgicp",
                description="Registration of point clouds with channels. --version prints the version, "
                "--tyro-print-completion bash (or zsh, tcsh) a script that completes commands and options.",
                args=args,
                config=(tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone),
            )
        except BrokenPipeError:
            raise
        except (RuntimeError, AssertionError):
            # JAX looks for its platform at the first computation.
            has_device = False
            with contextlib.suppress(RuntimeError, AssertionError):
                has_device = len(jax.devices()) > 0
            if has_device:
                raise
            problem = f"JAX has no device for JAX_PLATFORMS={os.environ.get('JAX_PLATFORMS')}"
            print(f"mcgicp: {problem}; unset it, or install its plugin", file=sys.stderr)
            return 2
        except (ValueError, OSError, ImportError) as error:
            print(f"mcgicp: {with_flags(reason_of(error), args)}", file=sys.stderr)
            return 2
        finally:
            LOGGER.removeHandler(handler)
            LOGGER.setLevel(level)


if __name__ == "__main__":
    sys.exit(main())
