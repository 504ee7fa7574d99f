#!/usr/bin/env python3
"""Odd and broken files, those of folders and crafted ones: each gets 2xx, or 4xx with a reason, in time, and delays no other client."""
import argparse, json, random, struct, sys, time
from pathlib import Path
from common import ROOT, Server, Table, Watch, check, chunk, end, form, png, ramp, small

# Seconds for the answer to an upload, and for another client's to a small question meanwhile; seconds until an accepted photo is made or
# given up; peaks of resident memory in MiB: of the server, and of the process that makes photos, whose own bound limits.job-memory is.
ANSWER, OTHERS, ENDS, SERVER, MAKER = 10, 5, 120, 1024, 2048


def of_folder(path):
    for file in sorted(p for p in path.rglob("*") if p.is_file()):
        yield str(file.relative_to(path)), file.read_bytes()


def jpeg_of(width, height, marker=0xC0):
    """A header that claims a size, and nothing behind it."""
    frame = struct.pack(">BHHB", 8, height, width, 3) + b"\x01\x11\x00\x02\x11\x01\x03\x11\x01"
    return b"\xff\xd8\xff" + bytes([marker]) + struct.pack(">H", len(frame) + 2) + frame


def png_of(width, height, depth=8, colour=2):
    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head)


def webp_of(width, height, flags=0):
    sides = struct.pack("<I", width - 1)[:3] + struct.pack("<I", height - 1)[:3]
    body = b"WEBPVP8X" + struct.pack("<I", 10) + bytes([flags, 0, 0, 0]) + sides
    return b"RIFF" + struct.pack("<I", len(body)) + body


def crafted(count, seed):
    """Pairs of a kind and files of it; the same for the same seed."""
    dice = random.Random(seed)
    samples = {"jpeg": (ROOT / "docs/sample.jpg").read_bytes(), "png": small(1, 160, 120)}
    for name, whole in samples.items():
        yield f"{name} cut short", [(f"{share:.3f}", whole[: int(len(whole) * share)]) for share in (dice.random() for _ in range(count))]
        flipped = []
        for n in range(count):
            bytes_ = bytearray(whole)
            # some anywhere, some in the headers
            for _ in range(dice.choice((1, 3, 30))):
                at = dice.randrange(len(bytes_) if n % 2 else min(len(bytes_), 700))
                bytes_[at] ^= 1 << dice.randrange(8)
            flipped.append((str(n), bytes(bytes_)))
        yield f"{name} with bits flipped", flipped
        spliced = []
        for n in range(count // 4):
            (a, b), other = sorted(dice.randrange(len(whole)) for _ in range(2)), dice.choice(list(samples.values()))
            spliced.append((str(n), whole[:a] + other[dice.randrange(len(other)) :][: b - a] + whole[b:]))
        yield f"{name} with another's bytes in it", spliced
        yield f"{name} with bytes behind it", [(str(n), whole + dice.randbytes(n)) for n in (1, 100, 100_000, 3_000_000)]
    sides = [(0, 0), (0, 9), (1, 1), (16_384, 1), (16_385, 1), (8000, 6000), (16_384, 16_384), (60_000, 60_000), (65_535, 65_535)]
    heads = [(f"{kind} {w}×{h}", make(w, h)) for kind, make in (("jpeg", jpeg_of), ("png", png_of)) for w, h in sides]
    heads += [(f"webp {w}×{h}", webp_of(w, h, flags)) for w, h in sides if w for flags in (0, 2, 16)]
    heads += [(f"jpeg of kind {marker:x}", jpeg_of(64, 64, marker)) for marker in range(0xC0, 0xD0)]
    heads += [(f"png of depth {d}, colour {c}", png_of(64, 64, d, c)) for d in (0, 1, 7, 16, 255) for c in (0, 1, 2, 3, 6, 255)]
    heads += [("png of 4 thousand million a side", png_of(2**32 - 1, 2**32 - 1))]
    yield "headers alone", heads
    with_trash = [(name, head + dice.randbytes(dice.choice((10, 1000, 100_000)))) for name, head in heads]
    yield "headers with noise behind them", with_trash
    magic = {
        "text": b"Dear Sir or Madam, this is no picture.", "html": b"<!doctype html><script>1</script>", "svg": b"<svg xmlns='http://www.w3.org/2000/svg'/>",
        "gif": b"GIF89a\x40\0\x40\0\x80\0\0", "bmp": b"BM" + bytes(60), "tiff": b"II*\0\x08\0\0\0" + bytes(60), "heic": b"\0\0\0\x18ftypheic" + bytes(60),
        "avif": b"\0\0\0\x18ftypavif" + bytes(60), "film": b"\0\0\0\x18ftypisom" + bytes(60), "zip": b"PK\x03\x04" + bytes(60), "program": b"\x7fELF" + bytes(60),
        "zeros": bytes(100_000), "noise": dice.randbytes(100_000), "one byte": b"\xff", "container": b"TMPI" + bytes(100),
    }
    yield "other things", list(magic.items())
    starts = (b"\xff\xd8\xff\xe0\0\x10JFIF\0", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", b"RIFF\x10\0\0\0WEBPVP8 ")
    yield "beginnings", [(f"{start[:4]} {n}", start[:n]) for start in starts for n in range(1, len(start) + 1)]
    yield "palettes", [(f"{n} bytes", png(64, 64, 1, (bytes(64) for _ in range(64)), chunk(b"PLTE", bytes(n)))) for n in (0, 1, 3, 767, 769)]


def reason(headers, body, status):
    """Why the answer is none with a reason; None where it is one."""
    if headers.get("content-type") != "application/problem+json":
        return f"it is {headers.get('content-type')}"
    try:
        problem = json.loads(body)
    except ValueError:
        return "it is no JSON"
    lacking = [name for name in ("type", "title", "detail") if not problem.get(name)]
    return f"it has no {lacking}" if lacking else None if problem.get("status") == status else f"it says {problem.get('status')}"


def one(server, name, bytes_):
    """Sends a file; its status, what it ended as, and the seconds until each of the two."""
    # with a map of its own no network is needed
    kind, body = form({"photo": bytes_, "depth": ramp(), "max_size": b"256"})
    began = time.monotonic()
    status, headers, answer = server.request("POST", "/v1/photos", body, {"content-type": kind}, timeout=60)
    took = time.monotonic() - began
    check(took <= ANSWER, f"{name}: answered after {took:.1f} s, not {ANSWER} s")
    if status not in (201, 202):
        refused = 400 <= status < 500 and status not in (408, 429)
        check(refused, f"{name}: answered {status} {answer[:200]}")
        if refused:
            why = reason(headers, answer, status)
            check(why is None, f"{name}: {status} without a reason: {why}")
        return str(status), took, 0.0
    state = server.wait(json.loads(answer)["id"], ENDS)
    ended = time.monotonic() - began
    if check(state["state"] in ("done", "failed"), f"{name}: {state['state']} after {ENDS} s") and state["state"] == "failed":
        problem = state["problem"]
        check(400 <= problem["status"] < 500 and problem.get("detail"), f"{name}: failed as {problem}")
    return state["state"], took, ended


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("folders", nargs="*", type=Path, help="folders of files, with all that is in them")
    args.add_argument("--count", type=int, help="files of each crafted kind")
    args.add_argument("--seed", type=int, default=7)
    args.add_argument("--full", action="store_true")
    args = args.parse_args()
    for folder in args.folders:
        if not folder.is_dir():
            sys.exit(f"there is no folder {folder}")
    count = args.count or (400 if args.full else 40)
    print(f"an answer within {ANSWER} s, others' within {OTHERS} s, an end within {ENDS} s, server {SERVER} MiB, maker {MAKER} MiB at most\n")
    server = Server("--set", f"limits.job-memory={MAKER}")
    status, good = server.upload(small(2, 96, 72), ramp())
    check(status in (201, 202) and server.wait(good["id"])["state"] == "done", "a photo is made")
    groups = [(str(folder), of_folder(folder)) for folder in args.folders] + list(crafted(count, args.seed))
    table = Table("files", "count", "made", "failed", "refused", "slowest answer", "slowest end", "others median", "worst", "not 200", "server", "maker")
    for group, files in groups:
        ends, answers, whole = [], [0.0], [0.0]
        with Watch(server, f"/v1/photos/{good['id']}/thumbnail") as watch:
            for name, bytes_ in files:
                end_, answered, ended = one(server, f"{group}: {name}", bytes_)
                ends.append(end_)
                answers.append(answered)
                whole.append(ended)
            # one look more at the memory
            time.sleep(0.2)
        check(watch.failed == 0, f"{group}: others are answered meanwhile")
        check(max(watch.times, default=0) <= OTHERS, f"{group}: another waited {max(watch.times, default=0):.1f} s")
        check(watch.peak <= SERVER, f"{group}: the server took {watch.peak:.0f} MiB")
        check(watch.maker <= MAKER, f"{group}: making took {watch.maker:.0f} MiB")
        refused = {status: ends.count(status) for status in sorted(set(ends) - {"done", "failed"})}
        table.row(
            group, len(ends), ends.count("done"), ends.count("failed"), ", ".join(f"{n} × {status}" for status, n in refused.items()),
            f"{max(answers):.2f} s", f"{max(whole):.2f} s", **watch.row(),
        )
    status, after = server.upload(small(3, 96, 72), ramp())
    check(status in (201, 202) and server.wait(after["id"])["state"] == "done", "the next photo is made")
    check(server.process.poll() is None, "the server runs")
    end()


main()
