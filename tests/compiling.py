"""How tests, texts and examples are compiled: fast, as most of it runs once, and once for all.

    eval "$(python tests/compiling.py)"

JAX and XLA read `ENVIRONMENT` when they are imported, so that whoever imports this must not have
imported them.
"""

import os
import re
import shlex
from importlib.metadata import version
from pathlib import Path

# What lowers fused loops takes half of the time that is left; without it they are fused as the
# shape has it, and without fused multiply-adds that changes no result. Other processes leave no
# core for further parts.
_FLAGS = (
    "--xla_cpu_use_fusion_emitters=false --xla_cpu_max_isa=AVX "
    "--xla_cpu_parallel_codegen_split_count=1"
)


def _flags(jax_version: str, given: str) -> str:
    """XLA's flags, each once: what is compiled is found again only by those who have the same."""
    major, minor = map(int, re.findall(r"\d+", jax_version)[:2])
    known = _FLAGS.split() if (major, minor) < (0, 11) else []  # another flag ends the process
    return " ".join([*given.split(), *(flag for flag in known if flag not in given.split())])


ENVIRONMENT = {
    "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    "JAX_COMPILATION_CACHE_DIR": str(Path(__file__).resolve().parents[1] / ".pytest_cache" / "jax"),
    # Small programs take no longer to compile than to write and read.
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1",
    "JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES": "none",  # for GPUs
    "XLA_FLAGS": _flags(version("jax"), os.environ.get("XLA_FLAGS", "")),
}

if __name__ == "__main__":
    for name, value in ENVIRONMENT.items():
        print(f"export {name}={shlex.quote(value)}")
