#!/usr/bin/env python3
"""Hundreds of viewers of a room, some of which pause reading; rooms on several nodes whose origin is killed; hostile publishers. Measures memory, lost
frames, and the time until viewers are live again."""
import argparse, os, subprocess, tempfile, threading, time
from pathlib import Path
from common import LAB, Server, Table, check, cpu, finish
from edge_nodes import edges
from hostile_publishers import hostile
from room_client import Readers, Viewer, publisher


def unsent(server):
    """Most unsent bytes that the kernel holds for one of the server's connections."""
    port, most = f"{server.address[1]:04X}", 0
    for line in open("/proc/net/tcp").readlines()[1:]:
        words = line.split()
        if words[1].endswith(":" + port) and words[3] == "01":
            most = max(most, int(words[4].split(":")[0], 16))
    return most


def audience(server, stream, count, stalled, seconds, table):
    room = f"room{count}"
    publishing = publisher(server, room, stream)
    readers, viewers = Readers(), []
    before = server.resident_mib()
    for n in range(count):
        # small receive buffers, so that the backlog of stalled viewers stays on the server
        viewers.append(Viewer(server, room, 65536 if n < stalled else None))
        readers.add(viewers[-1])
    time.sleep(3)
    joined, pausing = server.resident_mib(), viewers[:stalled]
    spent, began, highest, most = cpu(server.process), time.monotonic(), 0.0, 0
    frames = viewers[-1].frames
    samples, back = [], []
    # half of them resume before the server disconnects them, half after
    naps = [min(8, seconds / 4), min(20, seconds / 2)]
    asleep = {}
    while time.monotonic() - began < seconds:
        now = time.monotonic() - began
        for n, viewer in enumerate(pausing):
            nap = naps[n % 2]
            if id(viewer) not in asleep and now > 1 and now + nap + 3 < seconds:
                readers.pause(viewer)
                asleep[id(viewer)] = now
            elif id(viewer) in asleep and asleep[id(viewer)] is not None and now - asleep[id(viewer)] > nap:
                asleep[id(viewer)] = None
                threading.Thread(target=wake, args=(viewer, viewers[-1], readers, back), daemon=True).start()
        if all(v is None for v in asleep.values()) and len(back) == len(pausing) and now + naps[1] + 3 < seconds:
            asleep = {}
        resident = server.resident_mib()
        samples.append(resident)
        highest, most = max(highest, resident), max(most, unsent(server))
        time.sleep(0.5)
    spent, took = cpu(server.process) - spent, time.monotonic() - began
    healthy = viewers[stalled:]
    rate = (viewers[-1].frames - frames) / took
    lost = sum(v.lost for v in healthy)
    first = sorted(v.first or 99 for v in viewers)
    third = len(samples) // 3
    flat = max(samples[-third:]) - max(samples[:third])
    check(not readers.closed or stalled, f"no viewer is disconnected: {len(readers.closed)} were")
    check(max(samples[-third:]) < max(samples[:third]) * 1.05 + 4, f"memory stays flat: {max(samples[:third]):.0f}, then {max(samples[-third:]):.0f} MiB")
    if stalled:
        each = (highest - joined) / stalled
        check(each <= 1 and most <= 1 << 20, f"a stalled viewer takes at most 1 MiB: {each:.2f} MiB, {most} B in the kernel")
        check(back and max(back) <= 1, f"viewers are live again within a second: {[round(b, 2) for b in back]}")
        check(lost == 0, f"viewers that read lose no frame: {lost} lost")
        check(first[-1] <= 0.3, f"viewers get the first picture with depth within 300 ms: {first[-1]:.3f} s")
    table.row(count, stalled, f"{took:.0f} s", f"{rate:.1f}", lost, f"{first[len(first) // 2] * 1e3:.0f} ms", f"{first[-1] * 1e3:.0f} ms",
              f"{before:.0f} / {joined:.0f} / {highest:.0f} MiB", f"{flat:+.1f} MiB", f"{most >> 10} KiB", f"{max(back, default=0) * 1e3:.0f} ms",
              f"{100 * spent / took:.0f} %", f"{1e6 * spent / took / max(1, count) / max(rate, 1):.1f} µs", f"{os.getloadavg()[0]:.1f}")
    readers.stop()
    publishing.kill()
    publishing.wait()
    return rate, lost


def wake(viewer, other, readers, back):
    """Resumes reading; records how long the viewer takes to catch up with `other`."""
    began = time.monotonic()
    try:
        # the backlog may end with the server's close frame
        alive, quiet = True, 0
        while alive and quiet < 3:
            before = viewer.bytes
            alive = viewer.read()
            quiet = quiet + 1 if viewer.bytes == before else 0
            if other.last is not None and viewer.last is not None and viewer.last >= other.last - 3:
                break
        if not alive:
            viewer.socket.close()
            viewer.reconnects += 1
            viewer.last = None
            viewer.open()
        viewer.lost = 0
        while not (viewer.last is not None and other.last is not None and viewer.last >= other.last - 3) and time.monotonic() - began < 10:
            if not viewer.read():
                break
            time.sleep(0.002)
        back.append(time.monotonic() - began)
        readers.resume(viewer)
    except OSError as error:
        check(False, f"a paused viewer resumes: {error}")


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--full", action="store_true")
    args.add_argument("--seconds", type=int)
    args.add_argument("--only", choices=["viewers", "hostile", "edges"])
    args = args.parse_args()
    folder = tempfile.TemporaryDirectory(prefix="tmpi-live-")
    subprocess.run([LAB, "live-bench", "--only", "measured", "--frames", "150", "--views", "100000", "--files", folder.name], check=True, stdout=subprocess.DEVNULL)
    stream = str(Path(folder.name) / "measured.h264")
    if args.only in (None, "viewers"):
        server = Server("--set", "limits.connections=4096", "--set", "limits.connections-per-address=4096")
        seconds = args.seconds or (600 if args.full else 40)
        table = Table("viewers", "stalled", "for", "frames/s", "lost by others", "first view, median", "worst", "resident before / joined / peak", "last third − first",
                      "in a socket", "live again", "CPU of the server", "CPU per viewer and frame", "load")
        audience(server, stream, 20, 0, min(seconds, 10), table)
        audience(server, stream, 200, 10, seconds, table)
        count = 400
        while count <= (1000 if args.full else 400):
            rate, _ = audience(server, stream, count, 0, 10, table)
            if rate < 25:
                break
            count += 200
        server.stop()
    if args.only in (None, "edges"):
        edges(stream, args.full)
    if args.only in (None, "hostile"):
        server = Server()
        table = Table("publisher sends", "disconnect reason", "after", "resident", "frames/s of another room", "lost there")
        reasons = hostile(server, stream, table, args.full)
        print(f"\ndamaged frames: disconnected {len(reasons)} times: {sorted(set(reasons))[:5]}")
        check(server.process.poll() is None, "the server is still running")
        log = Path(server.log.name).read_text()
        check("panicked" not in log, f"no thread panics: {log[-500:]}")
        server.stop()
    finish()


if __name__ == "__main__":
    main()
