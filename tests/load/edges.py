"""Rooms of several nodes on a PostgreSQL and an S3 server of their own: what viewers at an edge cost beside viewers at the origin, and how long the origin's end is felt."""
import os, shutil, subprocess, sys, tempfile, time
from pathlib import Path
from common import PROGRAM, Server, Table, check
from engines import Postgres, free_port, s3_server

VIEWERS = 200


def node(postgres, s3):
    port = free_port()
    env = {
        "TMPI_SERVE_DATABASE": postgres.url,
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{s3.port}", "AWS_ALLOW_HTTP": "true", "AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "x", "AWS_REGION": "us-east-1",
    }
    args = ("--advertise", f"http://127.0.0.1:{port}", "--blobs", "s3://photos/tmpi", "--set", "limits.connections=4096", "--set", "limits.connections-per-address=4096")
    return Server(*args, env=env, port=port)


def edges(stream, full):
    if not Postgres.PROGRAMS:
        print("skipped, no PostgreSQL")
        return
    folder = Path(tempfile.mkdtemp(prefix="tmpi-edges-"))
    postgres, s3 = Postgres(folder), s3_server()
    nodes = [node(postgres, s3) for _ in range(3)]
    print(f"\nload of the machine {os.getloadavg()[0]:.1f}, {os.cpu_count()} processors\n")
    cost(nodes, stream, 20 if full else 8)
    print()
    table = Table("round", "publisher back after", "viewers at an edge go on after that, median", "worst", "sent away")
    worst = [killed(nodes, stream, n, table) for n in range(10 if full else 3)]
    check(max(worst) <= 2, f"viewers at an edge go on within 2 s of the publisher: {max(worst):.2f} s")
    for server in nodes:
        log = Path(server.log.name).read_text()
        check("panicked" not in log, f"nothing panicked: {log[-500:]}")
        server.stop()
    s3.kill()
    postgres.kill()
    shutil.rmtree(folder, ignore_errors=True)


def cost(nodes, stream, seconds):
    """Processor time and bytes for viewers at the origin, then for as many at an edge."""
    from live import Readers, Viewer, cpu, publisher
    a, _, c = nodes
    table = Table("viewers", "at", "CPU of the origin", "CPU of the edge", "of it a viewer and frame", "kB/s a viewer", "frames/s", "lost", "resident: origin, edge")
    sends = publisher(a, "cost", stream)
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
    wait(lambda: c.metric("tmpi_live_edges") == 0, "an edge without viewers ends")
    sends.kill(), sends.wait()


def killed(nodes, stream, n, table):
    """Kills the origin of a room whose viewers are at an edge; gives the longest time until one goes on after the publisher is back."""
    from live import Readers, Viewer
    a, b, c = nodes
    room, readers = f"killed{n}", Readers()
    addresses = ",".join(f"http://{s.address[0]}:{s.address[1]}/live/{room}" for s in (a, b))
    command = [PROGRAM, "live", "publish", stream, "--room", addresses, "--times", "100000"]
    sends = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait(lambda: b'"publishing":true' in a.get(f"/v1/live/{room}")[2], "the room is there")
    viewers = [Viewer(c, room) for _ in range(VIEWERS)]
    for viewer in viewers:
        readers.add(viewer)
    wait(lambda: all(v.begun for v in viewers), "all viewers see the room")
    a.kill()
    end = time.monotonic()
    wait(lambda: b'"publishing":true' in b.get(f"/v1/live/{room}")[2], "the publisher is back")
    back = time.monotonic()
    wait(lambda: all(v.begun and v.begun > end for v in viewers if v not in readers.closed), "all viewers go on")
    late = sorted(max(0, v.begun - back) for v in viewers if v.begun)
    check(not readers.closed, f"viewers at an edge stay: {len(readers.closed)} were sent away")
    table.row(n, f"{(back - end) * 1e3:.0f} ms", f"{late[len(late) // 2] * 1e3:.0f} ms", f"{late[-1] * 1e3:.0f} ms", len(readers.closed))
    readers.stop()
    sends.kill(), sends.wait()
    a.start()
    return late[-1]


def wait(true_now, what, seconds=30):
    until = time.monotonic() + seconds
    while not true_now():
        if time.monotonic() > until:
            sys.exit(f"{seconds} s are over before {what}")
        time.sleep(0.01)
