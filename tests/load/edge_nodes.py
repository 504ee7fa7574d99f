"""Rooms on several nodes with PostgreSQL and an S3 server: compares the cost of viewers at an edge and at the origin, and measures how long a killed origin
interrupts viewers."""
import os, shutil, subprocess, sys, tempfile, time
from pathlib import Path
from common import PROGRAM, Server, Table, check, cpu
from room_client import Readers, Viewer, publisher
from services import Postgres, free_port, s3_server

VIEWERS = 200


def start_node(postgres, s3):
    port = free_port()
    env = {
        "TMPI_SERVE_DATABASE": postgres.url,
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{s3.port}", "AWS_ALLOW_HTTP": "true", "AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "x", "AWS_REGION": "us-east-1",
    }
    args = ("--advertise", f"http://127.0.0.1:{port}", "--blobs", "s3://photos/tmpi", "--set", "limits.connections=4096", "--set", "limits.connections-per-address=4096")
    return Server(*args, env=env, port=port)


def edges(stream, full):
    if not Postgres.PROGRAMS:
        print("skipped: PostgreSQL is not installed")
        return
    folder = Path(tempfile.mkdtemp(prefix="tmpi-edges-"))
    postgres, s3 = Postgres(folder), s3_server()
    nodes = [start_node(postgres, s3) for _ in range(3)]
    print(f"\nmachine load {os.getloadavg()[0]:.1f}, {os.cpu_count()} processors\n")
    measure_cost(nodes, stream, 20 if full else 8)
    print()
    table = Table("round", "publisher back after", "viewers at an edge resume after that, median", "worst", "disconnected")
    worst = [kill_origin(nodes, stream, n, table) for n in range(10 if full else 3)]
    check(max(worst) <= 2, f"viewers at an edge resume within 2 s of the publisher: {max(worst):.2f} s")
    for server in nodes:
        log = Path(server.log.name).read_text()
        check("panicked" not in log, f"no thread panics: {log[-500:]}")
        server.stop()
    s3.kill()
    postgres.kill()
    shutil.rmtree(folder, ignore_errors=True)


def measure_cost(nodes, stream, seconds):
    """Measures CPU time and bytes for viewers at the origin, then for as many at an edge."""
    a, _, c = nodes
    table = Table("viewers", "at", "CPU of the origin", "CPU of the edge", "CPU per viewer and frame", "kB/s per viewer", "frames/s", "lost", "resident: origin, edge")
    publishing = publisher(a, "cost", stream)
    for count, at in ((0, "origin"), (VIEWERS, "origin"), (1, "edge"), (VIEWERS, "edge")):
        server, readers = (a if at == "origin" else c), Readers()
        viewers = [Viewer(server, "cost") for _ in range(count)]
        for viewer in viewers:
            readers.add(viewer)
        time.sleep(3)
        total = lambda: (sum(v.bytes for v in viewers), sum(v.frames for v in viewers), sum(v.lost for v in viewers))
        (sent, frames, lost), spent, began = total(), [cpu(s.process) for s in (a, c)], time.monotonic()
        time.sleep(seconds)
        took = time.monotonic() - began
        spent = [cpu(s.process) - then for s, then in zip((a, c), spent)]
        now = total()
        share = max(count, 1) * took
        rate = (now[1] - frames) / share
        each = spent[at == "edge"] * 1e6 / max(now[1] - frames, 1)
        table.row(count, at, *(f"{100 * s / took:.0f} %" for s in spent), f"{each:.1f} µs" if count > 1 else "", f"{(now[0] - sent) / share / 1e3:.1f}", f"{rate:.1f}",
                  now[2] - lost, f"{a.resident_mib():.0f}, {c.resident_mib():.0f} MiB")
        readers.stop()
    wait(lambda: c.metric("tmpi_live_edges") == 0, "an edge without viewers unsubscribes")
    publishing.kill(), publishing.wait()


def kill_origin(nodes, stream, n, table):
    """Kills the origin of a room with viewers at an edge; returns the longest time from the publisher's return until a viewer resumes."""
    a, b, c = nodes
    room, readers = f"killed{n}", Readers()
    addresses = ",".join(f"http://{s.address[0]}:{s.address[1]}/live/{room}" for s in (a, b))
    command = [PROGRAM, "live", "publish", stream, "--room", addresses, "--times", "100000"]
    publishing = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait(lambda: b'"publishing":true' in a.get(f"/v1/live/{room}")[2], "the publisher is connected")
    viewers = [Viewer(c, room) for _ in range(VIEWERS)]
    for viewer in viewers:
        readers.add(viewer)
    wait(lambda: all(v.begun for v in viewers), "all viewers see the room")
    a.kill()
    killed_at = time.monotonic()
    wait(lambda: b'"publishing":true' in b.get(f"/v1/live/{room}")[2], "the publisher is back")
    back = time.monotonic()
    wait(lambda: all(v.begun and v.begun > killed_at for v in viewers if v not in readers.closed), "all viewers resume")
    late = sorted(max(0, v.begun - back) for v in viewers if v.begun)
    check(not readers.closed, f"viewers at an edge stay connected: {len(readers.closed)} were disconnected")
    table.row(n, f"{(back - killed_at) * 1e3:.0f} ms", f"{late[len(late) // 2] * 1e3:.0f} ms", f"{late[-1] * 1e3:.0f} ms", len(readers.closed))
    readers.stop()
    publishing.kill(), publishing.wait()
    a.start()
    return late[-1]


def wait(condition, what, seconds=30):
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            sys.exit(f"timed out after {seconds} s: {what}")
        time.sleep(0.01)
