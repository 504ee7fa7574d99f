"""The training loop of all three networks: counted in steps alone, and resumed to the same bits.

The learning rate, the shape of a batch and what is in it are functions of the seed and the step. What else is random (dropout, mixed
statistics) comes from the generators of PyTorch, NumPy and Python, which are seeded at the start and stored with every checkpoint: a run that was
stopped and went on ends with the same weights, bit for bit, as one that was not, on the same machine with as many threads.
"""

import copy
import csv
import hashlib
import math
import random
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

import manifest


@dataclass(frozen=True)
class Plan:
    """What a run is, apart from its network and its data: a run with another plan is another run."""

    steps: int
    lr: float  # highest learning rate
    weight_decay: float
    ema: float  # decay of the running mean over weights
    every: int  # steps between rows of the log, measurements and checkpoints
    seed: int
    threads: int = 1
    warm: int = 50  # steps in which the learning rate rises to its highest


class Changed(SystemExit):
    """A run cannot go on: its plan, its options or its input files are not those that it began with."""


def rate(plan, step):
    """Learning rate of a step: a rise, then half a cosine down to a hundredth."""
    return plan.lr * (min(1, (step + 1) / plan.warm) * (0.5 + 0.5 * math.cos(math.pi * step / plan.steps)) + 0.01)


def stream(seed, *names):
    """A generator of its own for what the names say, whatever was drawn before from any other."""
    return random.Random(hashlib.sha256("/".join(map(str, (seed, *names))).encode()).digest())


def digest(value):
    """SHA-256 of tensors, arrays, numbers, texts and of lists and dictionaries of them, in hexadecimal."""
    h = hashlib.sha256()

    def add(v):
        if torch.is_tensor(v):
            v = v.detach().cpu().contiguous().numpy()
        if isinstance(v, np.ndarray):
            h.update(f"{v.dtype}{v.shape}".encode() + np.ascontiguousarray(v).tobytes())
        elif isinstance(v, dict):
            h.update(b"{")
            for k in v:
                h.update(repr(k).encode())
                add(v[k])
            h.update(b"}")
        elif isinstance(v, (list, tuple)):
            h.update(b"[")
            for w in v:
                add(w)
            h.update(b"]")
        else:
            h.update(repr(v).encode() + b",")

    add(value)
    return h.hexdigest()


def generators():
    """States of all generators that a step may draw from."""
    cards = torch.cuda.get_rng_state_all() if torch.cuda.is_available() else []
    return {"torch": torch.get_rng_state(), "cards": cards, "numpy": np.random.get_state(), "python": random.getstate()}


def restore(states):
    torch.set_rng_state(states["torch"])
    if len(states["cards"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all(states["cards"])
    np.random.set_state(states["numpy"])
    random.setstate(states["python"])


def seed_all(seed):
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)


@torch.no_grad()
def blend(mean, live, step, decay):
    """Moves the running mean of all weights and buffers; early steps count for more."""
    d = min(decay, (1 + step) / (10 + step))
    for m, v in zip(mean.state_dict().values(), live.state_dict().values(), strict=True):
        if v.dtype.is_floating_point:
            m.lerp_(v, 1 - d)
        else:
            m.copy_(v)


def reached(out):
    """Steps that the run in a folder has come to."""
    last = Path(out) / "last.pt"
    return torch.load(last, weights_only=False, map_location="cpu")["step"] if last.exists() else 0


def save(path, state):
    part = Path(f"{path}.part")
    torch.save(state, part)
    part.replace(path)


def train(out, plan, net, loss_at, inputs, options=None, measure=None, stop=None, minutes=None, mean=None, quiet=False, slow=(), gain=1.0):
    """Trains `net`, goes on from `out`/last.pt where that is there, and returns the state at the end.

    `loss_at(step)` gives a dictionary of scalar tensors of which `loss` is descended; `measure(mean)` gives figures of the running mean of the
    weights, of which the smallest `score`, if there is one, makes best.pt. `inputs` is what the run reads, by name: lists of files. `options` are
    whatever else decides what the run does. `stop` ends it early, after that many steps, and `minutes` after so long, to go on later. `mean` is the
    module that the running mean is kept in, where the caller has one: a copy of `net`. The parameters `slow` learn at the share `gain` of the rate and
    are not drawn to 0: they were trained elsewhere. A step whose gradient is not finite is left out (`left out` in the log). Raises [`Changed`].
    """
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(plan.threads)
    device = next(net.parameters()).device
    # a card has no such algorithms for all that is needed here
    torch.use_deterministic_algorithms(device.type == "cpu")
    # it would try all algorithms anew for every shape
    torch.backends.cudnn.benchmark = False
    wanted = {"plan": asdict(plan), "options": options or {}}
    params = [p for p in net.parameters() if p.requires_grad]
    groups, known = [], {id(p) for p in slow}
    for own, of in (([p for p in params if id(p) not in known], {}), (list(slow), {"gain": gain, "weight_decay": 0.0})):
        groups += [{"params": own, **of}] if own else []
    optimiser = torch.optim.AdamW(groups, plan.lr, weight_decay=plan.weight_decay)
    mean = (copy.deepcopy(net) if mean is None else mean).eval().requires_grad_(False)
    step, best, rows, seen = 0, math.inf, [], {}
    if (out / "last.pt").exists():
        s = torch.load(out / "last.pt", weights_only=False, map_location="cpu")
        if s["wanted"] != wanted:
            raise Changed(f"{out}: begun with {s['wanted']}, not with {wanted}; name another folder with --out")
        net.load_state_dict(s["live"])
        mean.load_state_dict(s["mean"])
        optimiser.load_state_dict(s["optimiser"])
        step, best, rows, seen = s["step"], s["best"], s["rows"], s["seen"]
    else:
        s = None
        seed_all(plan.seed)
    manifest.begin(out, step, inputs, wanted)
    # last of all, so that nothing above has drawn from them
    if s is not None:
        restore(s["generators"])
    end, start = min(plan.steps, stop or plan.steps), time.time()
    while step < end:
        for group in optimiser.param_groups:
            group["lr"] = rate(plan, step) * group.get("gain", 1.0)
        net.train()
        parts = loss_at(step)
        optimiser.zero_grad()
        parts["loss"].backward()
        norm = torch.nn.utils.clip_grad_norm_(params, 1.0)
        for p in params:
            if p.grad is not None:
                p.grad.nan_to_num_(0, 0, 0)
        optimiser.step()
        step += 1
        blend(mean, net, step, plan.ema)
        # figures stay on the device until they are told: fetching one waits for all that it has under way
        for k, v in (parts | {"left out": (~norm.isfinite()).float()}).items():
            seen.setdefault(k, []).append(v.detach())
        if minutes and time.time() - start > 60 * minutes:
            end = step
        whole = step % plan.every == 0 or step == plan.steps
        if whole:
            row = {"step": step, **{k: average(v) for k, v in seen.items()}, **(measure(mean) if measure else {})}
            rows, seen = [*rows, row], {}
            if row.get("score", math.inf) < best:
                best = row["score"]
                save(out / "best.pt", {"mean": mean.state_dict(), "step": step, "row": row})
            if not quiet:
                print(f"[{time.time() - start:6.0f} s] " + " ".join(f"{k} {v:.4f}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()), flush=True)
        if whole or step == end:
            state = {
                "wanted": wanted, "live": net.state_dict(), "mean": mean.state_dict(), "optimiser": optimiser.state_dict(),
                "step": step, "best": best, "rows": rows, "seen": {k: [float(x) for x in v] for k, v in seen.items()}, "generators": generators(),
            }  # fmt: skip
            save(out / "last.pt", state)
            write_log(out / "log.csv", rows)
            manifest.finished(out, step, digest(state))
    return torch.load(out / "last.pt", weights_only=False, map_location="cpu")


def average(values):
    """Mean of numbers and of tensors of one number, of those that are finite."""
    values = np.array([float(v) for v in values])
    return float(values[np.isfinite(values)].mean()) if np.isfinite(values).any() else math.nan


def write_log(path, rows):
    """All rows so far: a step that was run twice, before and after a stop, stands there once."""
    columns = list(dict.fromkeys(k for r in rows for k in r))
    with open(path, "w", newline="") as f:
        w = csv.DictWriter(f, columns)
        w.writeheader()
        w.writerows(rows)


def arguments(parser, steps, seed, every):
    """The options that every training has."""
    parser.add_argument("--steps", type=int, default=steps, help="length of the whole run: the learning rate falls over it")
    parser.add_argument("--stop", type=int, help="end after that many steps; the same command without it goes on")
    parser.add_argument("--minutes", type=float, help="end after so long")
    parser.add_argument("--every", type=int, default=every, help="steps between checkpoints")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seed", type=int, default=seed)


def remaining(args, *but):
    """Options that decide what a run does and are not in its plan, for `train`."""
    return {k: v for k, v in sorted(vars(args).items()) if k not in {"steps", "stop", "minutes", "every", "threads", "seed", "out", *but}}
