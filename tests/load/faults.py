#!/usr/bin/env python3
"""Faults of the machine: a full disk, a missing ONNX Runtime library. The server loses no photo and recovers by itself."""
import argparse, json, os, shutil, subprocess, tempfile, time
from pathlib import Path
from common import ROOT, Server, Table, check, depth_map, finish, skip, small


def full_disk(table, uploads):
    folder = tempfile.mkdtemp(prefix="tmpi-load-")
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=20m", "tmpfs", folder], capture_output=True).returncode:
        return skip("full disk", "mounting a small disk needs root")
    server = None
    try:
        server = Server("--set", "limits.queue=200", data=folder)
        server.log.close()
        server.log = open("/dev/null", "a")
        filler = Path(folder, "filler")
        depth = depth_map()
        accepted, refused = [], {}
        for seed in range(uploads):
            if seed == uploads // 3:
                with open(filler, "wb") as file:
                    try:
                        while True:
                            file.write(bytes(1 << 16))
                            file.flush()
                    except OSError:
                        pass
            status, answer = server.upload(small(seed), depth)
            if status in (201, 202):
                accepted.append(answer["id"])
            else:
                refused[status] = refused.get(status, 0) + 1
        time.sleep(3)
        states = [server.state(photo)["state"] for photo in accepted]
        ready = server.get("/readyz")
        check(ready[0] == 503, f"/readyz reports a full disk: {ready[0]}")
        check("failed" not in states, f"no photo fails: {states}")
        check(set(refused) <= {507}, f"the server rejects uploads with 507: {refused}")
        filler.unlink()
        began = time.monotonic()
        states = [server.wait(photo, 120)["state"] for photo in accepted]
        took = time.monotonic() - began
        check(all(state == "done" for state in states), f"all photos are made once there is space: {states}")
        status, answer = server.upload(small(1000), depth)
        check(status in (201, 202), f"the server accepts uploads again: {status}")
        table.row(f"full disk, {uploads} uploads", f"{len(accepted)} accepted, rejected {refused}", f"all done {took:.1f} s after space was freed")
    finally:
        if server:
            server.stop()
        subprocess.run(["umount", folder], capture_output=True)
        shutil.rmtree(folder, ignore_errors=True)


def missing_library(table):
    candidates = [Path(os.environ.get("ORT_DYLIB_PATH", "")), ROOT / ".tmpi/onnxruntime/libonnxruntime.so"]
    found = next((path for path in candidates if path.is_file()), None)
    if not found:
        return skip("missing library", "ONNX Runtime is not installed")
    folder = tempfile.mkdtemp(prefix="tmpi-load-")
    link = Path(folder, "libonnxruntime.so")
    server = Server(env={"ORT_DYLIB_PATH": str(link)})
    estimated = [server.upload(small(seed))[1]["id"] for seed in range(3)]
    with_map = server.upload(small(9), depth_map())[1]["id"]
    check(server.wait(with_map, 60)["state"] == "done", "a photo with its own depth map is made without the library")
    time.sleep(1)
    states = [server.state(photo) for photo in estimated]
    check(all(state["state"] in ("queued", "working") for state in states), f"photos wait: {[s['state'] for s in states]}")
    ready = server.get("/readyz")
    check(ready[0] == 503, f"/readyz reports it: {ready[0]}")
    link.symlink_to(found)
    began = time.monotonic()
    states = [server.wait(photo, 180)["state"] for photo in estimated]
    took = time.monotonic() - began
    check(all(state == "done" for state in states), f"all photos are made once the library is there: {states}")
    check(server.get("/readyz")[0] == 200, "/readyz is 200 again")
    reason = json.loads(ready[2]).get("detail", "")[:60] if ready[0] == 503 else ""
    table.row("missing library", f"3 photos wait, /readyz {ready[0]}: {reason}…", f"all done {took:.1f} s after it appeared")
    server.remove()
    shutil.rmtree(folder, ignore_errors=True)


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--full", action="store_true")
    full = args.parse_args().full
    table = Table("fault", "outcome", "recovery")
    full_disk(table, 60 if full else 30)
    missing_library(table)
    finish()


main()
