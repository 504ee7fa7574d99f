#!/usr/bin/env python3
"""`kill -9` during uploads loses no photo and fails none; the server detects, reports and repairs corrupted blobs; it rejects or reports damaged JPEGs."""
import argparse, json, os, queue, threading, time
from common import Server, Table, blob_files, check, depth_map, finish, small


def crashes(table, kills, uploads):
    server = Server("--set", "limits.queue=200")
    photos, accepted = queue.Queue(), {}
    for seed in range(uploads):
        photos.put((seed, small(seed)))
    depth, stop = depth_map(), threading.Event()

    def client():
        while not stop.is_set():
            try:
                seed, photo = photos.get_nowait()
            except queue.Empty:
                return
            while True:
                status, answer = server.upload(photo, depth, timeout=20)
                if status in (201, 202):
                    accepted[seed] = answer["id"]
                    break
                time.sleep(0.05)

    began = time.monotonic()
    threads = [threading.Thread(target=client) for _ in range(4)]
    for thread in threads:
        thread.start()
    done_kills = 0
    for _ in range(kills):
        time.sleep(0.4)
        server.kill()
        done_kills += 1
        server.start()
    for thread in threads:
        thread.join()
    states = [server.wait(photo)["state"] for photo in accepted.values()]
    took = time.monotonic() - began
    listed, path = set(), "/v1/photos?limit=200"
    while path:
        page = json.loads(server.get(path)[2])
        listed |= {photo["id"] for photo in page["photos"]}
        path = page.get("next")
    unreadable = sum(server.get(f"/v1/photos/{photo}/view?w=32")[0] != 200 for photo in accepted.values())
    lost = len(set(accepted.values()) - listed)
    failed = sum(state != "done" for state in states)
    left = os.listdir(server.data / "data/blobs/incoming")
    complete = len(accepted) == uploads and not lost and not failed and not unreadable and not left
    check(complete, f"no photo is lost or fails: {uploads} uploads, {lost} lost, {failed} failed, {unreadable} unreadable, {left}")
    table.row(f"{done_kills} × kill -9 during {uploads} uploads", f"{lost} lost, {failed} failed, {unreadable} unreadable", f"{took:.0f} s")
    server.remove()


def corruption(table):
    server = Server()
    photo, depth = small(1), depth_map()
    status, answer = server.upload(photo, depth)
    check(server.wait(answer["id"])["state"] == "done", "the photo is made")
    whole = blob_files(server, answer["id"], "container")[0].read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    for name, bytes_ in (("flipped", bytes(flipped)), ("truncated", whole[: len(whole) // 2]), ("missing", None)):
        for path in ("atlas", "view?w=33", None):
            server.stop()
            atlas = blob_files(server, answer["id"], "container")[0]
            atlas.unlink() if bytes_ is None else atlas.write_bytes(bytes_)
            server.start()
            response = server.get(f"/v1/photos/{answer['id']}/{path}")[0] if path else "no request"
            state = server.wait(answer["id"], 30)["state"]
            if path:
                check((response, state) == (500, "damaged"), f"{name}, {path}: status {response}, state {state}")
            server.upload(photo, depth)
            after = server.wait(answer["id"])["state"]
            repaired = after == "done" and server.get(f"/v1/photos/{answer['id']}/atlas")[2] == whole
            check(repaired, f"{name}, {path}: the same upload repairs the photo")
            table.row(f"atlas {name}, GET {path or 'nothing'}", f"status {response}, state {state}", "repaired" if repaired else "not repaired")
    jpeg = server.get(f"/v1/photos/{answer['id']}/view?w=480&format=jpeg")[2]
    overwritten = bytearray(jpeg)
    overwritten[len(jpeg) // 2 : len(jpeg) // 2 + 400] = b"\x55" * 400
    files = {
        "intact": jpeg,
        "end marker in the middle": jpeg[: len(jpeg) // 2] + b"\xff\xd9",
        "last tenth missing": jpeg[: len(jpeg) * 9 // 10],
        "400 bytes overwritten": bytes(overwritten),
    }
    for name, bytes_ in files.items():
        status, got = server.upload(bytes_, depth)
        outcome = got.get("detail", "")[:60]
        if status in (201, 202):
            state = server.wait(got["id"])
            report = json.loads(server.get(f"/v1/photos/{got['id']}/report")[2]) if state["state"] == "done" else {}
            problem = state.get("problem", {}).get("type", "").rsplit(":", 1)[-1]
            outcome = f"{state['state']} {problem}, damaged: {report.get('input', {}).get('damaged')}"
            reported = bool(report.get("input", {}).get("damaged")) or problem == "broken-photo"
            check((name == "intact") != reported, f"JPEG, {name}: {outcome}")
        else:
            check(status == 422 and name != "intact", f"JPEG, {name}: {status} {outcome}")
        table.row(f"JPEG, {name}", status, outcome)
    server.remove()


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--full", action="store_true")
    full = args.parse_args().full
    table = Table("case", "outcome", "then")
    crashes(table, 30 if full else 5, 100 if full else 20)
    corruption(table)
    finish()


main()
