"""Trackers on loopback that behave badly."""

import socket
import threading
import time
from contextlib import suppress

BUFFER = 1 << 16
ANSWER = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nContent-Length: 2\r\n\r\n{}"
BACKLOG = 64


class Listener:
    """A server that accepts every connection, and answers each after ``seconds``; None: never."""

    def __init__(self, seconds=None):
        self.seconds = seconds
        self._socket = socket.create_server(("127.0.0.1", 0), backlog=BACKLOG)
        self.port = self._socket.getsockname()[1]
        self.connections = []
        self.threads = 1  # number of threads that were started here
        threading.Thread(target=self._accept, daemon=True).start()

    def __enter__(self):
        return self

    def __exit__(self, *reason):
        for connection in [self._socket, *self.connections]:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            connection.close()

    def _accept(self):
        with suppress(OSError):
            while True:
                connection, _ = self._socket.accept()
                self.connections.append(connection)
                self.threads += 1
                threading.Thread(target=self.serve, args=(connection,), daemon=True).start()

    def serve(self, connection):
        if self.seconds is not None:
            time.sleep(self.seconds)
            with suppress(OSError):
                connection.sendall(ANSWER)


class Gate(Listener):
    """Passes everything on to the server at ``target`` until ``limit`` bytes were sent to it.

    Then it breaks all connections and refuses new ones, or keeps them and passes nothing on, until
    it is `mended`.
    """

    def __init__(self, target):
        self.target = target
        self.passed = 0
        self.limit = None
        self.then = "close"
        super().__init__()

    def mended(self):
        self.limit = None

    @property
    def _broken(self):
        return self.limit is not None and self.passed >= self.limit

    def serve(self, connection):
        if self._broken and self.then == "close":
            connection.close()
            return
        try:
            server = socket.create_connection(("127.0.0.1", self.target))
        except OSError:
            connection.close()
            return
        self.connections.append(server)
        threading.Thread(
            target=self._pass_on, args=(server, connection, False), daemon=True
        ).start()
        self._pass_on(connection, server, True)

    def _pass_on(self, source, goal, counted):
        with suppress(OSError):
            while data := source.recv(BUFFER):
                if counted:
                    self.passed += len(data)
                if self._broken and self.then == "hang":
                    return
                if self._broken:
                    break
                goal.sendall(data)
        for end in (source, goal):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
