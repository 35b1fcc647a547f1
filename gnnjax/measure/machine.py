"""What numbers were measured on."""

import functools
import importlib.metadata
import platform
from pathlib import Path
from typing import Any

import jax

from gnnjax.devices import num_cores
from gnnjax.files import code_version


@functools.cache
def describe_machine() -> dict[str, Any]:
    """What the numbers were measured on."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [x for x in cpuinfo.read_text().splitlines() if x.startswith("model name")]
        model = names[0].split(":", 1)[1].strip() if names else model
    return {
        "processor": model,
        "cores": num_cores(),
        "device": jax.devices()[0].device_kind,
        "python": platform.python_version(),
        "jax": jax.__version__,
        "gnnjax": code_version(),
    }


def ompl_version(plans: bool) -> dict[str, str]:
    """The version of OMPL, where it plans."""
    return {"ompl": importlib.metadata.version("ompl")} if plans else {}
