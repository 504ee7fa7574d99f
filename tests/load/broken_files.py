#!/usr/bin/env python3
"""Uploads odd and broken files, from folders and crafted: each gets 2xx, or 4xx with a reason, in time, and delays no other client."""
import argparse, json, random, struct, sys, time
from pathlib import Path
from common import ROOT, Server, Table, Watch, check, chunk, depth_map, finish, multipart, png, small

# Seconds until the response to an upload, until the response to another client's light request, and until an accepted photo is done or failed;
# peak resident memory in MiB of the server, and of the process that makes photos (limits.job-memory).
RESPONSE, OTHERS, OUTCOME, SERVER, MAKER = 10, 5, 120, 1024, 2048


def files_in(path):
    for file in sorted(p for p in path.rglob("*") if p.is_file()):
        yield str(file.relative_to(path)), file.read_bytes()


def jpeg_header(width, height, marker=0xC0):
    """A header that claims a size, without image data."""
    frame = struct.pack(">BHHB", 8, height, width, 3) + b"\x01\x11\x00\x02\x11\x01\x03\x11\x01"
    return b"\xff\xd8\xff" + bytes([marker]) + struct.pack(">H", len(frame) + 2) + frame


def png_header(width, height, depth=8, colour=2):
    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head)


def webp_header(width, height, flags=0):
    sides = struct.pack("<I", width - 1)[:3] + struct.pack("<I", height - 1)[:3]
    body = b"WEBPVP8X" + struct.pack("<I", 10) + bytes([flags, 0, 0, 0]) + sides
    return b"RIFF" + struct.pack("<I", len(body)) + body


def crafted(count, seed):
    """Yields kinds with their files; the same seed gives the same files."""
    rng = random.Random(seed)
    samples = {"jpeg": (ROOT / "docs/sample.jpg").read_bytes(), "png": small(1, 160, 120)}
    for name, intact in samples.items():
        yield f"{name} truncated", [(f"{share:.3f}", intact[: int(len(intact) * share)]) for share in (rng.random() for _ in range(count))]
        flipped = []
        for n in range(count):
            bytes_ = bytearray(intact)
            # half of the files have their flips in the headers
            for _ in range(rng.choice((1, 3, 30))):
                at = rng.randrange(len(bytes_) if n % 2 else min(len(bytes_), 700))
                bytes_[at] ^= 1 << rng.randrange(8)
            flipped.append((str(n), bytes(bytes_)))
        yield f"{name} with flipped bits", flipped
        spliced = []
        for n in range(count // 4):
            (a, b), other = sorted(rng.randrange(len(intact)) for _ in range(2)), rng.choice(list(samples.values()))
            spliced.append((str(n), intact[:a] + other[rng.randrange(len(other)) :][: b - a] + intact[b:]))
        yield f"{name} with bytes of another file", spliced
        yield f"{name} with trailing bytes", [(str(n), intact + rng.randbytes(n)) for n in (1, 100, 100_000, 3_000_000)]
    sides = [(0, 0), (0, 9), (1, 1), (16_384, 1), (16_385, 1), (8000, 6000), (16_384, 16_384), (60_000, 60_000), (65_535, 65_535)]
    heads = [(f"{kind} {w}×{h}", make(w, h)) for kind, make in (("jpeg", jpeg_header), ("png", png_header)) for w, h in sides]
    heads += [(f"webp {w}×{h}", webp_header(w, h, flags)) for w, h in sides if w for flags in (0, 2, 16)]
    heads += [(f"jpeg with SOF {marker:x}", jpeg_header(64, 64, marker)) for marker in range(0xC0, 0xD0)]
    heads += [(f"png of depth {d}, colour {c}", png_header(64, 64, d, c)) for d in (0, 1, 7, 16, 255) for c in (0, 1, 2, 3, 6, 255)]
    heads += [("png of 4 billion pixels a side", png_header(2**32 - 1, 2**32 - 1))]
    yield "headers only", heads
    with_noise = [(name, head + rng.randbytes(rng.choice((10, 1000, 100_000)))) for name, head in heads]
    yield "headers followed by noise", with_noise
    magic = {
        "text": b"Dear Sir or Madam, this is no picture.", "html": b"<!doctype html><script>1</script>", "svg": b"<svg xmlns='http://www.w3.org/2000/svg'/>",
        "gif": b"GIF89a\x40\0\x40\0\x80\0\0", "bmp": b"BM" + bytes(60), "tiff": b"II*\0\x08\0\0\0" + bytes(60), "heic": b"\0\0\0\x18ftypheic" + bytes(60),
        "avif": b"\0\0\0\x18ftypavif" + bytes(60), "mp4": b"\0\0\0\x18ftypisom" + bytes(60), "zip": b"PK\x03\x04" + bytes(60), "elf": b"\x7fELF" + bytes(60),
        "zeros": bytes(100_000), "noise": rng.randbytes(100_000), "one byte": b"\xff", "container": b"TMPI" + bytes(100),
    }
    yield "other file types", list(magic.items())
    starts = (b"\xff\xd8\xff\xe0\0\x10JFIF\0", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", b"RIFF\x10\0\0\0WEBPVP8 ")
    yield "first bytes of a file", [(f"{start[:4]} {n}", start[:n]) for start in starts for n in range(1, len(start) + 1)]
    yield "palettes", [(f"{n} bytes", png(64, 64, 1, (bytes(64) for _ in range(64)), chunk(b"PLTE", bytes(n)))) for n in (0, 1, 3, 767, 769)]


def problem_fault(headers, body, status):
    """What is wrong with a problem response, or None."""
    if headers.get("content-type") != "application/problem+json":
        return f"content type {headers.get('content-type')}"
    try:
        problem = json.loads(body)
    except ValueError:
        return "not JSON"
    missing = [name for name in ("type", "title", "detail") if not problem.get(name)]
    return f"no {missing}" if missing else None if problem.get("status") == status else f"says status {problem.get('status')}"


def upload_file(server, name, bytes_):
    """Uploads a file; returns its status or final state, seconds until the response, and seconds until done or failed."""
    # a depth map avoids the network
    content_type, body = multipart({"photo": bytes_, "depth": depth_map(), "max_size": b"256"})
    began = time.monotonic()
    status, headers, answer = server.request("POST", "/v1/photos", body, {"content-type": content_type}, timeout=60)
    took = time.monotonic() - began
    check(took <= RESPONSE, f"{name}: response after {took:.1f} s, limit {RESPONSE} s")
    if status not in (201, 202):
        rejected = 400 <= status < 500 and status not in (408, 429)
        check(rejected, f"{name}: status {status} {answer[:200]}")
        if rejected:
            fault = problem_fault(headers, answer, status)
            check(fault is None, f"{name}: {status} without a reason: {fault}")
        return str(status), took, 0.0
    state = server.wait(json.loads(answer)["id"], OUTCOME)
    ended = time.monotonic() - began
    if check(state["state"] in ("done", "failed"), f"{name}: {state['state']} after {OUTCOME} s") and state["state"] == "failed":
        problem = state["problem"]
        check(400 <= problem["status"] < 500 and problem.get("detail"), f"{name}: failed as {problem}")
    return state["state"], took, ended


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("folders", nargs="*", type=Path, help="folders whose files to upload, recursively")
    args.add_argument("--count", type=int, help="files per crafted kind")
    args.add_argument("--seed", type=int, default=7)
    args.add_argument("--full", action="store_true")
    args = args.parse_args()
    for folder in args.folders:
        if not folder.is_dir():
            sys.exit(f"not a folder: {folder}")
    count = args.count or (400 if args.full else 40)
    print(f"limits: response within {RESPONSE} s, for others {OTHERS} s, done or failed within {OUTCOME} s, server {SERVER} MiB, process that makes photos {MAKER} MiB\n")
    server = Server("--set", f"limits.job-memory={MAKER}")
    status, good = server.upload(small(2, 96, 72), depth_map())
    check(status in (201, 202) and server.wait(good["id"])["state"] == "done", "the first photo is made")
    groups = [(str(folder), files_in(folder)) for folder in args.folders] + list(crafted(count, args.seed))
    table = Table("files", "count", "made", "failed", "rejected", "slowest response", "slowest outcome", "others median", "worst", "not 200", "server", "maker")
    for group, files in groups:
        outcomes, response_times, total_times = [], [0.0], [0.0]
        with Watch(server, f"/v1/photos/{good['id']}/thumbnail") as watch:
            for name, bytes_ in files:
                outcome, answered, ended = upload_file(server, f"{group}: {name}", bytes_)
                outcomes.append(outcome)
                response_times.append(answered)
                total_times.append(ended)
            # let the watch sample memory once more
            time.sleep(0.2)
        check(watch.failed == 0, f"{group}: other clients get responses")
        check(max(watch.times, default=0) <= OTHERS, f"{group}: another client waited {max(watch.times, default=0):.1f} s")
        check(watch.peak <= SERVER, f"{group}: the server took {watch.peak:.0f} MiB")
        check(watch.maker_peak <= MAKER, f"{group}: making took {watch.maker_peak:.0f} MiB")
        rejected = {status: outcomes.count(status) for status in sorted(set(outcomes) - {"done", "failed"})}
        table.row(
            group, len(outcomes), outcomes.count("done"), outcomes.count("failed"), ", ".join(f"{n} × {status}" for status, n in rejected.items()),
            f"{max(response_times):.2f} s", f"{max(total_times):.2f} s", **watch.row(),
        )
    status, after = server.upload(small(3, 96, 72), depth_map())
    check(status in (201, 202) and server.wait(after["id"])["state"] == "done", "the next photo is made")
    check(server.process.poll() is None, "the server is still running")
    finish()


main()
