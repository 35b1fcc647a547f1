"""What compiled code depends on besides the program: the machine, libraries, and settings."""

import functools
import hashlib
import os
import platform
import sys
from pathlib import Path
from typing import Any

import jax
import jaxlib
import jaxtyping
import mujoco
import numpy as np
import scipy

from gnnjax.devices import num_cores
from gnnjax.files import cache_folder

_DEBUGGING = ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs", "jax_enable_checks")


# What /proc/cpuinfo calls it, on x86 and on ARM.
_PROCESSOR = ("vendor_id", "cpu family", "model", "model name", "stepping", "flags")
_PROCESSOR += ("CPU implementer", "CPU architecture", "CPU variant", "CPU part", "Features")


def _xla_environment() -> list[tuple[str, str]]:
    return sorted(x for x in os.environ.items() if x[0].startswith(("XLA_", "TF_")))


def sources_digest(folder: Path) -> str:
    """The digest of all Python files of a folder and those in it, with their names."""
    found = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        text = path.read_bytes()
        found.update(f"{path.relative_to(folder).as_posix()}:{len(text)}:".encode() + text)
    return found.hexdigest()


# As this process was started with. What is changed later, it may or may not have seen.
SOURCES = sources_digest(Path(__file__).parent)
_ENVIRONMENT = _xla_environment()


def keeps_code() -> bool:
    """Whether this process keeps what it compiles: where `cache_compilations` has chosen JAX's
    cache, and there is one device, a CPU that tells what it is.

    Elsewhere code depends on drivers, and on which of many devices it was made for.
    """
    config: Any = jax.config
    return (
        config.jax_enable_compilation_cache
        and config.jax_compilation_cache_dir == str(cache_folder("jax"))
        and not any(getattr(config, name) for name in _DEBUGGING)
        and jax.default_backend() == "cpu"
        and jax.device_count() == 1
        and _processor() is not None
    )


@functools.cache
def machine() -> list[Any]:
    """Versions, the processor, and what XLA was started with, for `digest`."""
    libraries = jax, jaxlib, np, scipy, mujoco, jaxtyping
    device = jax.devices()[0]
    return [
        sys.version,
        platform.platform(),
        [(library.__name__, library.__version__) for library in libraries],
        [device.client.platform, device.client.platform_version, device.device_kind],
        # Loops are cut into as many parts as there are cores.
        [os.cpu_count(), num_cores()],
        _processor(),
        _ENVIRONMENT,
    ]


def settings() -> list[Any]:
    """JAX's settings, as they are here and now, but for what is kept where; for `digest`."""
    config: Any = jax.config
    here = {name: getattr(config, name, value) for name, value in config.values.items()}
    named = [(name, repr(here[name])) for name in sorted(here) if "cache" not in name]
    return [named, _xla_environment()]


@functools.cache
def _processor() -> tuple[str, ...] | None:
    """What the first processor says of itself; None where none does."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    lines = [line.partition(":") for line in text.partition("\n\n")[0].splitlines()]
    told = {name.strip(): value.strip() for name, _, value in lines}
    found = tuple(f"{name}: {told[name]}" for name in _PROCESSOR if name in told)
    return found if "flags" in told or "Features" in told else None
