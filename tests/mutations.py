"""Damages valid inputs at random and reads them: success or one clear line, nothing else.

    python -m tests.mutations --number 1000 --seed 0

They are read in another process, so that a crash inside of a parser written in C or reading without
end is seen as what it is.
"""

import argparse
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from tests.damaged_inputs import arms, checkpoints, manifests, problem_files, scenes

_ROOT = Path(__file__).parents[1]
_LIMIT_S = 20  # for one input
_MEMORY = 12 * 2**30  # of addresses; JAX reserves a few GiB

KINDS = {
    "scenes": (scenes, 0.25),
    "problem_files": (problem_files, 0.25),
    "manifests": (manifests, 0.15),
    "arms": (arms, 0.2),
    "checkpoints": (checkpoints, 0.15),
}


def judge(read: Callable[[], object]) -> str:
    """ "read", "refused", or what is wrong with how the input was taken."""
    from gnnjax.errors import InputError

    begin = time.perf_counter()
    try:
        read()
        outcome = "read"
    except InputError as error:
        text = str(error)
        line = len(text) < 300 and len(text.splitlines()) == 1 and text.isprintable()
        outcome = "refused" if line else f"{len(text)} characters: {text[:200]!r}"
    except BaseException as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        outcome = f"{type(error).__name__} at {where.filename}:{where.lineno}: {str(error)[:200]!r}"
    seconds = time.perf_counter() - begin
    return outcome if seconds < _LIMIT_S / 2 else f"{outcome} after {seconds:.1f} s"


def read_kind(kind: str, numbers: range, seed: int) -> None:
    """Reads some mutated inputs of a kind; a line each, begun before it is read."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        make = KINDS[kind][0](folder)
        os.chdir(folder)  # where MuJoCo writes its log
        for number in numbers:
            rng = random.Random(f"{kind} {seed} {number}")
            path = folder / f"input{number}"
            read = make(rng, path)
            print(json.dumps([kind, number, "begun"]), flush=True)
            signal.alarm(_LIMIT_S)
            with tempfile.TemporaryFile() as words:
                terminal = os.dup(2)
                os.dup2(words.fileno(), 2)
                outcome = judge(read)
                os.dup2(terminal, 2)
                os.close(terminal)
                words.seek(0)
                if said := words.read():  # by a library, past the error
                    outcome += f" and said {said[:300]!r}"
            signal.alarm(0)
            print(json.dumps([kind, number, outcome]), flush=True)
            shutil.rmtree(path, ignore_errors=True)
        os.chdir("/")


def try_kinds(numbers: dict[str, int], seed: int) -> dict[str, dict[int, str]]:
    """What became of inputs of each kind; begins anew after one that ends the process."""
    outcomes: dict[str, dict[int, str]] = {kind: {} for kind in numbers}
    left = {kind: range(number) for kind, number in numbers.items()}
    while left:
        command = [sys.executable, "-m", "tests.mutations", "--seed", str(seed), "--read"]
        command += [f"{kind}:{own.start}:{own.stop}" for kind, own in left.items()]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", cwd=_ROOT)
        rows = [json.loads(x) for x in done.stdout.splitlines() if x.startswith("[")]
        if not rows:
            raise RuntimeError(f"{next(iter(left))}: nothing was read\n{done.stderr[-2000:]}")
        for kind, number, outcome in rows:
            outcomes[kind][number] = outcome
        kind, number, outcome = rows[-1]
        if outcome == "begun":
            ended = f"the process ended with {done.returncode}: {done.stderr[-300:]!r}"
            outcomes[kind][number] = ended
        left = {k: range(len(outcomes[k]), own.stop) for k, own in left.items()}
        left = {k: own for k, own in left.items() if own}
    return outcomes


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--number", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--read", nargs="+", help="inputs to read here, as arms:7:9 for 7 and 8")
    arguments = parser.parse_args()
    if arguments.read:
        resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
        for kind, first, end in (words.split(":") for words in arguments.read):
            read_kind(kind, range(int(first), int(end)), arguments.seed)
        return 0
    wrong = 0
    numbers = {kind: round(share * arguments.number) for kind, (_, share) in KINDS.items()}
    for kind, outcomes in try_kinds(numbers, arguments.seed).items():
        counts = [sum(x == y for x in outcomes.values()) for y in ("read", "refused")]
        print(f"{kind}: {len(outcomes)} inputs, {counts[0]} read, {counts[1]} refused", flush=True)
        for number, outcome in outcomes.items():
            if outcome not in ("read", "refused"):
                print(f"  {number}: {outcome}")
                wrong += 1
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
