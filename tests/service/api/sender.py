"""Sends one large measurement file: `python sender.py PORT PATH MEGABYTES`; prints the answer."""

from __future__ import annotations

import http.client
import sys

BOUNDARY = "part"
HEAD = (
    f"--{BOUNDARY}\r\n"
    'Content-Disposition: form-data; name="file"; filename="raw_data_x.csv"\r\n\r\n'
    "#time,accel_x,accel_y,accel_z\n"
).encode()
TAIL = f"\r\n--{BOUNDARY}--\r\n".encode()
ROWS = b"".join(b"%.6f,%d.5,%d.25,9810.125\n" % (n / 3200, n % 97, n % 89) for n in range(30_000))


def main(port: int, path: str, megabytes: int) -> None:
    times = -(-megabytes * 10**6 // len(ROWS))
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=300)
    connection.putrequest("POST", path)
    connection.putheader("Content-Type", f"multipart/form-data; boundary={BOUNDARY}")
    connection.putheader("Content-Length", str(len(HEAD) + times * len(ROWS) + len(TAIL)))
    connection.endheaders()
    connection.send(HEAD)
    for _ in range(times):
        connection.send(ROWS)
    connection.send(TAIL)
    answer = connection.getresponse()
    print(answer.status, answer.read().decode())


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
