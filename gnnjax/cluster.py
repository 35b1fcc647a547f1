"""Commands in several processes: the options that say so, and which of them this one is."""

import atexit
import contextlib
import dataclasses
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

import jax
import tyro

from gnnjax.errors import InputError
from gnnjax.roll_call import Place, RollCall

# Where launchers tell a process its number, and how many there are.
_LAUNCHERS = (
    ("SLURM_PROCID", "SLURM_NTASKS"),
    ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE"),
)
_A_DAY = 24 * 3600  # s


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClusterOptions:
    """Several processes, on one machine or many, that are started with the same command."""

    distributed: bool = False
    """Share the work with the other processes of a Slurm step or of mpirun, or with those that the
    next two options count. All need to see the same folders. Results do not depend on how many
    there are; weights of a training are equal to rounding. Started again, in whatever number, they
    go on."""
    process_id: int | None = None
    """Number of this process, from 0."""
    process_count: int | None = None
    """How many processes there are."""
    patience: float = 120.0
    """Seconds without a sign after which a process counts as lost, and the others end."""

    def place(self) -> Place:
        """Which of how many processes this one is.

        Raises:
            InputError: neither the options nor a launcher say so, or it cannot be.
        """
        index, count = self.process_id, self.process_count
        if not self.distributed:
            if (index, count) != (None, None):
                raise InputError(
                    f"process_id is {index} and process_count {count}; add --distributed, or leave "
                    "them out"
                )
            return Place()
        if not 0 < self.patience < float("inf"):
            raise InputError(f"patience is {self.patience}; it must be positive and finite")
        if index is None and count is None:
            named = [names for names in _LAUNCHERS if all(name in os.environ for name in names)]
            if not named:
                raise InputError(
                    "distributed, and neither Slurm nor mpirun has started this process; use srun, "
                    "or add --process-id and --process-count"
                )
            index, count = (os.environ[name] for name in named[0])
        try:
            place = Place(int(index), int(count))  # pyright: ignore[reportArgumentType]
        except (TypeError, ValueError):
            place = Place(-1, -1)
        if not 0 <= place.index < place.count:
            raise InputError(
                f"process {index} of {count}; give --process-count, and --process-id from 0 to one "
                "less"
            )
        return place

    def roll_call(self, target: Path) -> RollCall:
        """Of the processes that make `target`, each its parts."""
        return RollCall(target, self.place(), self.patience)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ConnectedOptions(ClusterOptions):
    """Several processes, on one machine or many, that are started with the same command."""

    coordinator: str | None = None
    """Address of process 0, host:port. Not needed with Slurm or mpirun, or where JAX's environment
    variable JAX_COORDINATOR_ADDRESS tells it."""

    @contextlib.contextmanager
    def connected(self, target: Path) -> Iterator[Place]:
        """The processes that make `target` together, connected by `jax.distributed`: in here, JAX
        sees the devices of all of them.

        When one is lost, the others end, too.

        Raises:
            InputError: they cannot be connected.
        """
        place = self.place()
        if self.coordinator is not None and not self.distributed:
            raise InputError(
                f"coordinator is {self.coordinator!r}; add --distributed, or leave it out"
            )
        if place.count == 1:
            yield place
            return
        with RollCall(target, place, self.patience, all_at_once=True) as others:
            try:
                self._connect(place)
                yield place
                others.gather()
            except BaseException:
                # At its end, JAX would wait for the others, which are about to end without it.
                atexit.register(_leave)
                raise
        jax.distributed.shutdown()

    def _connect(self, place: Place) -> None:
        address = self.coordinator
        if address is not None and not address.rpartition(":")[2].isdigit():
            raise InputError(f"coordinator is {address!r}; give host:port of process 0")
        try:
            jax.distributed.initialize(
                address,
                place.count,
                place.index,
                # Who is missing or lost is told by the roll call, in a sentence, and not where all
                # were stopped for a while. JAX ends the process with a page of words.
                initialization_timeout=_A_DAY,
                heartbeat_timeout_seconds=_A_DAY,
            )
        except (ValueError, RuntimeError) as error:
            where = "--coordinator host:port" if address is None else "the coordinator's address"
            raise InputError(
                f"process {place.index} of {place.count} is not connected ({error}); check {where}"
            ) from None


def _leave() -> None:
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(2)


# As a field of a command's options; in their help, a group of its own.
Cluster: TypeAlias = tyro.conf.OmitArgPrefixes[ClusterOptions]
ConnectedCluster: TypeAlias = tyro.conf.OmitArgPrefixes[ConnectedOptions]
ALONE, UNCONNECTED = ClusterOptions(), ConnectedOptions()
