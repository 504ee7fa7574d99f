#!/usr/bin/env python3
"""`kill -9` under uploads loses and fails nothing; damage on disk is noticed, reported and repaired; damaged JPEGs are refused or reported."""
import argparse, json, os, queue, threading, time
from common import check, contents, end, ramp, small, Server, Table


def crashes(table, kills, uploads):
    server = Server("--set", "limits.queue=200")
    photos, accepted = queue.Queue(), {}
    for seed in range(uploads):
        photos.put((seed, small(seed)))
    depth, stop = ramp(), threading.Event()

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
    check(len(accepted) == uploads and not lost and not failed and not unreadable and not left, f"{uploads} uploads, {lost} lost, {failed} failed, {unreadable} unreadable, {left}")
    table.row(f"{done_kills} × kill -9 under {uploads} uploads", f"{lost} lost, {failed} failed, {unreadable} unreadable", f"{took:.0f} s")
    server.remove()


def damage(table):
    server = Server()
    photo, depth = small(1), ramp()
    status, answer = server.upload(photo, depth)
    check(server.wait(answer["id"])["state"] == "done", "a photo is made")
    whole = contents(server, answer["id"], "container")[0].read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    for name, bytes_ in (("flipped", bytes(flipped)), ("cut", whole[: len(whole) // 2]), ("missing", None)):
        for ask in ("atlas", "view?w=33", None):
            server.stop()
            atlas = contents(server, answer["id"], "container")[0]
            atlas.unlink() if bytes_ is None else atlas.write_bytes(bytes_)
            server.start()
            told = server.get(f"/v1/photos/{answer['id']}/{ask}")[0] if ask else "not asked"
            state = server.wait(answer["id"], 30)["state"]
            if ask:
                check((told, state) == (500, "damaged"), f"{name}, {ask}: told {told}, state {state}")
            server.upload(photo, depth)
            after = server.wait(answer["id"])["state"]
            healed = after == "done" and server.get(f"/v1/photos/{answer['id']}/atlas")[2] == whole
            check(healed, f"{name}, {ask}: healed by the same upload")
            table.row(f"atlas {name}, asked for {ask or 'nothing'}", f"told {told}, state {state}", "healed" if healed else "not healed")
    jpeg = server.get(f"/v1/photos/{answer['id']}/view?w=480&format=jpeg")[2]
    spoilt = bytearray(jpeg)
    spoilt[len(jpeg) // 2 : len(jpeg) // 2 + 400] = b"\x55" * 400
    for name, bytes_ in (("whole", jpeg), ("end in the middle", jpeg[: len(jpeg) // 2] + b"\xff\xd9"), ("last tenth gone", jpeg[: len(jpeg) * 9 // 10]), ("400 bytes overwritten", bytes(spoilt))):
        status, got = server.upload(bytes_, depth)
        told = got.get("detail", "")[:60]
        if status in (201, 202):
            state = server.wait(got["id"])
            report = json.loads(server.get(f"/v1/photos/{got['id']}/report")[2]) if state["state"] == "done" else {}
            problem = state.get("problem", {}).get("type", "").rsplit(":", 1)[-1]
            told = f"{state['state']} {problem}, damaged: {report.get('input', {}).get('damaged')}"
            said = bool(report.get("input", {}).get("damaged")) or problem == "broken-photo"
            check((name == "whole") != said, f"JPEG, {name}: {told}")
        else:
            check(status == 422 and name != "whole", f"JPEG, {name}: {status} {told}")
        table.row(f"JPEG, {name}", status, told)
    server.remove()


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--full", action="store_true")
    full = args.parse_args().full
    table = Table("what", "outcome", "then")
    crashes(table, 30 if full else 5, 100 if full else 20)
    damage(table)
    end()


main()
