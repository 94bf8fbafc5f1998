"""A simulator in metres: an area of 3 km by 2 km, UAVs of 12, 15 and 20 m/s, errors of 5 m in every measurement, a UAV that is lost, a user that
appears and one that leaves. It lists only what a UAV detects.

python metric_simulator.py 127.0.0.1:50051 --policy qedgix
"""

import argparse

import grpc
import numpy as np

from qedgix.v1 import policy_pb2 as pb

AREA, SLOT, TRANSMISSION_RANGE, DETECTION_RANGE = np.array([3000.0, 2000.0]), 8.0, 360.0, 840.0  # m, m, s, m, m


def observe(uavs, users, time, noisy):
    """What the UAVs detect."""
    graph, seen = pb.Graph(), set()
    for id, (at, speed) in uavs.items():
        x, y = noisy(at)
        node = graph.nodes.add(id=id, kind=pb.NODE_KIND_UAV, position={"x": x, "y": y}, speed=speed)
        others = [(other, to, None) for other, (to, _) in uavs.items() if other != id]
        sensors = [(user, to, (time - last) / SLOT) for user, (to, last) in users.items()]
        for target, to, aoi in others + sensors:
            if np.linalg.norm(to - at) <= DETECTION_RANGE:
                x, y = noisy(to - at)
                node.detections.add(target_id=target, rel_x=x, rel_y=y, aoi=aoi)
                seen |= {target} - uavs.keys()
    for user in sorted(seen):
        graph.nodes.add(id=user, kind=pb.NODE_KIND_USER)
    return graph


def fly(channel, policy, seed=1):
    """Flies 80 slots and returns the mean AoI in seconds."""
    def method(name, request, response):
        path = f"/qedgix.v1.PolicyService/{name}"
        return channel.unary_unary(path, request_serializer=request.SerializeToString, response_deserializer=response.FromString)

    open_session, act = method("OpenSession", pb.OpenSessionRequest, pb.Session), method("Act", pb.ActRequest, pb.ActResponse)
    close_session = method("CloseSession", pb.CloseSessionRequest, pb.Session)
    frame = {"width": AREA[0], "height": AREA[1]}
    world = {"slot_seconds": SLOT, "speed": 15.0, "transmission_range": TRANSMISSION_RANGE, "detection_range": DETECTION_RANGE}
    session = open_session(pb.OpenSessionRequest(policy=policy, frame=frame, world=world))
    for warning in session.warnings:
        print(f"{warning.field}: {warning.message}")
    random = np.random.default_rng(seed)
    uavs = {f"drone-{i}": [AREA / 2, speed] for i, speed in enumerate([12.0, 15.0, 20.0])}
    users = {f"sensor-{i}": [random.uniform(0, AREA), 0.0] for i in range(5)}
    ages = []
    for step in range(80):
        time = step * SLOT
        if time == 200:
            users["sensor-late"] = [np.array([400.0, 400.0]), time]
        if time == 304:
            del uavs["drone-1"]
        if time == 504:
            del users["sensor-2"]
        graph = observe(uavs, users, time, lambda at: at + random.normal(0, 5, 2))
        answer = act(pb.ActRequest(session_id=session.session_id, step=step, graph=graph, return_velocity=True))
        for action in answer.actions:
            uav, velocity = uavs[action.uav_id], np.array([action.velocity.x, action.velocity.y])
            uav[0] = np.clip(uav[0] + SLOT * velocity, 0, AREA)
        for user in users.values():
            if any(np.linalg.norm(at - user[0]) <= TRANSMISSION_RANGE for at, _ in uavs.values()):
                user[1] = time + SLOT
        ages.append(np.mean([time + SLOT - last for _, last in users.values()]))
    close_session(pb.CloseSessionRequest(session_id=session.session_id))
    return np.mean(ages)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("address", nargs="?", default="127.0.0.1:50051")
    parser.add_argument("--policy", default="qedgix")
    arguments = parser.parse_args()
    with grpc.insecure_channel(arguments.address) as channel:
        print(f"{arguments.policy}: 80 of 80 slots answered, mean AoI {fly(channel, arguments.policy):.1f} s")
