#!/usr/bin/env python3
"""Uploads small files that need many resources; measures response, time, peak memory, and other clients' latency."""
import argparse, base64, struct, time, zlib
from common import Server, Table, Watch, check, chunk, depth_map, finish, noise, png, size_of, small

# Seconds until the response to an upload; peak resident memory in MiB of the server and of the process that makes photos. limits.job-memory
# bounds the latter. 50 megapixels take up to 3.6 GiB.
RESPONSE, SERVER, MAKER, MAKER_FULL = 10, 1024, 2048, 6144


def segment(marker, data):
    return bytes([0xFF, marker]) + struct.pack(">H", len(data) + 2) + data


def scans(side, count):
    """A progressive grey JPEG with `count` empty scans."""
    head = b"\xff\xd8" + segment(0xDB, b"\0" + b"\x10" * 64)
    head += segment(0xC2, struct.pack(">BHHB", 8, side, side, 1) + b"\x01\x11\x00")
    head += segment(0xC4, b"\x00\x01" + bytes(15) + b"\x00") + segment(0xC4, b"\x10\x01" + bytes(15) + b"\x00")
    return head + segment(0xDA, b"\x01\x01\x00\x00\x00\x00") * count + b"\xff\xd9"


def claims(width, height):
    """A baseline JPEG that claims a size and ends after a few blocks."""
    head = b"\xff\xd8" + segment(0xDB, b"\0" + b"\x10" * 64)
    head += segment(0xC0, struct.pack(">BHHB", 8, height, width, 1) + b"\x01\x11\x00")
    head += segment(0xC4, b"\x00\x01" + bytes(15) + b"\x00") + segment(0xC4, b"\x10\x01" + bytes(15) + b"\x00")
    return head + segment(0xDA, b"\x01\x01\x00\x00\x3f\x00") + bytes(9000) + b"\xff\xd9"


def compressed_zeros(mebibytes):
    compressor = zlib.compressobj(9)
    return b"".join(compressor.compress(bytes(1 << 20)) for _ in range(mebibytes)) + compressor.flush()


def one_colour(width, height):
    return png(width, height, 3, (b"\x7f" * (3 * width) for _ in range(height)))


def with_chunks(extra):
    return png(64, 64, 3, (bytes([90]) * 192 for _ in range(64)), extra)


def exif(bytes_):
    """An orientation tag that holds `bytes_` empty strings."""
    return b"II*\0" + struct.pack("<IHHHIII", 8, 1, 0x0112, 2, bytes_, 26, 0) + bytes(bytes_)


def frames(count):
    """An animated WebP of one-pixel frames."""
    file = base64.b64decode("UklGRh4AAABXRUJQVlA4TBEAAAAvAAAAAAfQ//73v/+BiOh/AAA=")
    picture = file[12:]
    picture += b"\0" * (len(picture) % 2)
    frame = bytes(16)[:12] + b"\x0a\0\0\0" + picture
    block = b"ANMF" + struct.pack("<I", len(frame)) + frame
    body = b"WEBP" + b"VP8X" + struct.pack("<I", 10) + b"\x02\0\0\0" + bytes(6) + b"ANIM" + struct.pack("<I", 6) + bytes(6) + block * count
    return b"RIFF" + struct.pack("<I", len(body)) + body


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--full", action="store_true")
    full = args.parse_args().full
    body = 31 << 20
    profile = compressed_zeros(1024 if full else 64)
    cases = [
        ("scan bomb, 10 kB", lambda: (scans(4096, 1000), "")),
        ("scan bomb, 10 kB, reduced", lambda: (scans(4096, 1000), "?max-size=64")),
        (f"scan bomb, {body >> 20} MiB", lambda: (scans(4096, body // 10), "?max-size=64")),
        ("9 kB that claims 16384×3000", lambda: (claims(16384, 3000), "")),
        (f"ICC of {1024 if full else 64} MiB", lambda: (with_chunks(chunk(b"iCCP", b"p\0\0" + profile)), "")),
        (f"zTXt of {1024 if full else 64} MiB", lambda: (with_chunks(chunk(b"zTXt", b"t\0\0" + profile)), "")),
        ("1.2 million text chunks", lambda: (with_chunks(chunk(b"tEXt", b"a\0bcdefgh") * 1_200_000), "")),
        ("31 MB of EXIF", lambda: (with_chunks(chunk(b"eXIf", exif(31_000_000))), "")),
        ("90 000 frames", lambda: (frames(90_000), "")),
        ("20 000×20 000 of one colour", lambda: (one_colour(20_000, 20_000), "")),
        ("50 MP of one colour" if full else "12 MP of one colour", lambda: (one_colour(*size_of(49.9 if full else 12)), "")),
        ("12 MP, planes=64", lambda: (noise(12), "?planes=64")),
        ("tile=8&planes=48", lambda: (noise(0.5), "?tile=8&planes=48")),
    ]
    most = MAKER_FULL if full else MAKER
    print(f"limits: response within {RESPONSE} s, server {SERVER} MiB, process that makes photos {most} MiB\n")
    table = Table("upload", "bytes", "response", "response time", "outcome", "total time", "others median", "worst", "not 200", "server", "maker")
    for name, make in cases:
        photo, query = make()
        server = Server("--set", f"limits.job-memory={most}")
        with Watch(server) as watch:
            time.sleep(0.5)
            began = time.monotonic()
            # a depth map avoids the network; a raw body takes its options from the query
            depth = None if query else depth_map()
            status, answer = server.upload(photo, depth, query, timeout=300)
            answered = time.monotonic() - began
            check(answered <= RESPONSE, f"{name}: response after {answered:.1f} s, limit {RESPONSE} s")
            outcome, took = "", ""
            if status in (201, 202):
                state = server.wait(answer["id"], 900)
                outcome, took = state["state"], f"{time.monotonic() - began:.2f} s"
                if state["state"] == "failed":
                    outcome += " " + state["problem"]["type"].rsplit(":", 1)[1]
                check(state["state"] in ("done", "failed"), f"{name}: done or failed within 15 minutes")
            else:
                outcome = answer.get("type", "").rsplit(":", 1)[-1] + " " + answer.get("detail", "")[:70]
            check(status in (201, 202) or 400 <= status < 500, f"{name}: status {status}")
            status_next, after = server.upload(small(1, 96, 72), depth_map())
            check(status_next in (201, 202) and server.wait(after["id"], 120)["state"] == "done", f"the next photo is made after {name}")
            time.sleep(0.2)
        row = watch.row()
        check(watch.failed == 0, f"{name}: /healthz responds during the upload")
        check(watch.peak <= SERVER, f"{name}: the server took {watch.peak:.0f} MiB, over {SERVER} MiB")
        check(watch.maker_peak <= most, f"{name}: making took {watch.maker_peak:.0f} MiB, over {most} MiB")
        table.row(name, len(photo), status, f"{answered:.2f} s", outcome, took, **row)
        server.remove()
    finish()


main()
