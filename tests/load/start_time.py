#!/usr/bin/env python3
"""Starts with many photos and measures time to the first response, memory, and the photo list; with warm system caches and, as root, with cold ones."""
import argparse, subprocess, time
from common import Server, Table, check, depth_map, duplicate_photo, finish, small


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--photos", type=int)
    args.add_argument("--full", action="store_true")
    args = args.parse_args()
    count = args.photos or (100_000 if args.full else 5_000)
    server = Server()
    status, answer = server.upload(small(1, 80, 60), depth_map())
    check(server.wait(answer["id"])["state"] == "done", "the photo is made")
    server.stop()
    duplicate_photo(server, answer["id"], [f"{n:032x}" for n in range(1, count)])
    subprocess.run(["sync"])
    table = Table("caches", "photos", "start", "resident", "list of 50", "list of 200")
    for kind in ("cold", "warm", "warm"):
        if kind == "cold":
            try:
                with open("/proc/sys/vm/drop_caches", "w") as drop:
                    drop.write("3")
            except OSError:
                kind = "not dropped"
        server.start(600)
        lists = []
        for limit in (50, 200):
            began = time.monotonic()
            status = server.get(f"/v1/photos?limit={limit}")[0]
            check(status == 200, f"GET /v1/photos responds: {status}")
            lists.append(f"{(time.monotonic() - began) * 1e3:.1f} ms")
        check(server.metric("tmpi_photos_done") == count, f"the server has all photos: {server.metric('tmpi_photos_done')}")
        table.row(kind, count, f"{server.started_in:.2f} s", f"{server.resident_mib():.0f} MiB", *lists)
        server.stop()
    finish()


main()
