"""Machines for the tests of the page."""

from __future__ import annotations

from tests.service.machines import make_machine, with_accel
from tests.web.served import Service

__all__ = ["put"]


def put(service: Service, name: str) -> None:
    """A machine with two revisions, made over HTTP."""
    machine = make_machine(name, kinematics="cartesian")
    where = f"/v1/machines/{name}"
    made = service.api.put(where, content=machine.model_dump_json(), params={"author": "anna"})
    assert made.status_code == 201, made.text
    changed = with_accel(machine, 4321.0)
    answer = service.api.put(
        where,
        content=changed.model_dump_json(),
        params={"author": "ben", "message": "new motors"},
        headers={"If-Match": made.headers["etag"]},
    )
    assert answer.status_code == 200, answer.text
