"""A stand-in of the Hub: the part of its HTTP interface that `huggingface_hub` speaks for models, kept in memory."""

import base64
import hashlib
import json
import re
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlparse

WRITER, READER = "hf_writer", "hf_reader"
LARGE = (".safetensors", ".gif", ".png", ".mp4", ".onnx")
"""endings of files that go through the storage of large files"""


class Refused(Exception):
    """An answer with an error: its status, and the headers that the Hub names the error with."""

    def __init__(self, status, code="", message=""):
        self.status, self.headers = status, {"X-Error-Code": code, "X-Error-Message": message}


class Repository:
    """Commits, each with all its files; the last one is `main`."""

    def __init__(self, private):
        self.private, self.commits, self.tags = private, {}, {}
        self.commit({".gitattributes": b""})

    def commit(self, files):
        """Add a commit of these files; its hash."""
        sha = hashlib.sha1(f"{len(self.commits)} {sorted(files)}".encode()).hexdigest()
        self.commits[sha] = files
        return sha

    def sha_of(self, revision):
        """The commit of a branch, a tag or a hash. Raises `Refused`."""
        sha = [*self.commits][-1] if revision == "main" else self.tags.get(revision, revision)
        if sha not in self.commits:
            raise Refused(404, "RevisionNotFound")
        return sha


class Hub(ThreadingHTTPServer):
    """Repositories by name, large files by sha256, and a log of what was asked for."""

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.endpoint = f"http://127.0.0.1:{self.server_address[1]}"
        self.repositories, self.large, self.asked, self.status = {}, {}, [], None

    def files(self, name, revision="main"):
        """The files of a repository, by their paths."""
        repository = self.repositories[name]
        return repository.commits[repository.sha_of(revision)]


class Handler(BaseHTTPRequestHandler):
    """One request."""

    protocol_version = "HTTP/1.1"
    server: Hub

    def answer(self):
        """Find the function for the path, and send what it returns."""
        path = unquote(urlparse(self.path).path)
        self.body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        self.server.asked.append(f"{self.command} {path}")
        try:
            if self.server.status:
                raise Refused(self.server.status, message="down for maintenance")
            for pattern, function in ROUTES.items():
                if found := re.fullmatch(pattern, f"{self.command} {path}"):
                    return self.send(*function(self, *found.groups()))
            raise Refused(404)
        except Refused as refused:
            self.send(refused.status, b"", refused.headers)

    do_GET = do_HEAD = do_POST = do_PUT = answer

    def send(self, status, content, headers=None):
        content = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        for name, value in {"Content-Length": len(content), **(headers or {})}.items():
            self.send_header(name, str(value))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def log_message(self, *arguments):
        """Say nothing."""

    @property
    def token(self):
        token = (self.headers.get("Authorization") or "").removeprefix("Bearer ")
        if token not in ("", WRITER, READER):
            raise Refused(401, message="Invalid credentials in Authorization header")
        return token

    def require_writer(self):
        if self.token != WRITER:
            raise Refused(403 if self.token else 401, message="Forbidden")

    def repository(self, name):
        token, found = self.token, self.server.repositories.get(name)
        if found is None or (found.private and not token):
            raise Refused(404 if token else 401, "RepoNotFound")
        return found

    def create(self):
        self.require_writer()
        asked = json.loads(self.body)
        name = f"{asked['organization']}/{asked['name']}"
        known = name in self.server.repositories
        if not known:
            self.server.repositories[name] = Repository(asked.get("visibility") == "private" or asked.get("private"))
        return 409 if known else 200, {"url": f"{self.server.endpoint}/{name}"}

    def info(self, name, revision=None):
        repository = self.repository(name)
        sha = repository.sha_of(revision or "main")
        siblings = [{"rfilename": path} for path in repository.commits[sha]]
        return 200, {"id": name, "sha": sha, "private": bool(repository.private), "siblings": siblings}

    def tree(self, name, revision):
        repository = self.repository(name)
        entries = []
        for path, content in repository.commits[repository.sha_of(revision)].items():
            entry = {"type": "file", "path": path, "size": len(content), "oid": hashlib.sha1(content).hexdigest()}
            if path.endswith(LARGE):
                entry["lfs"] = {"oid": hashlib.sha256(content).hexdigest(), "size": len(content), "pointerSize": 130}
            entries.append(entry)
        return 200, entries

    def validate(self):
        return 200, {"errors": [], "warnings": []}

    def preupload(self, name, _):
        self.require_writer()
        paths = [file["path"] for file in json.loads(self.body)["files"]]
        modes = {path: "lfs" if path.endswith(LARGE) else "regular" for path in paths}
        return 200, {"files": [{"path": p, "uploadMode": modes[p], "shouldIgnore": False} for p in paths]}

    def batch(self, name):
        self.require_writer()
        objects = json.loads(self.body)["objects"]
        for item in objects:
            item["actions"] = {"upload": {"href": f"{self.server.endpoint}/large/{item['oid']}"}}
        return 200, {"transfer": "basic", "objects": objects}

    def put(self, oid):
        assert hashlib.sha256(self.body).hexdigest() == oid
        self.server.large[oid] = self.body
        return 200, b""

    def commit(self, name, revision):
        self.require_writer()
        repository = self.repository(name)
        files = dict(repository.commits[repository.sha_of(revision)])
        for line in self.body.splitlines():
            asked = json.loads(line)
            kind, value = asked["key"], asked["value"]
            if kind == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif kind == "lfsFile":
                files[value["path"]] = self.server.large[value["oid"]]
            elif kind == "deletedFile":
                del files[value["path"]]
        sha = repository.commit(files)
        return 200, {"commitUrl": f"{self.server.endpoint}/{name}/commit/{sha}", "commitOid": sha}

    def resolve(self, name, revision, path):
        repository = self.repository(name)
        sha = repository.sha_of(revision)
        content = repository.commits[sha].get(path)
        if content is None:
            raise Refused(404, "EntryNotFound")
        oid = hashlib.sha256(content).hexdigest()
        headers = {"X-Repo-Commit": sha, "ETag": f'"{oid}"'}
        if not path.endswith(LARGE):
            return 200, content, headers
        self.server.large[oid] = content
        place = f"{self.server.endpoint.replace('127.0.0.1', 'localhost')}/large/{oid}"  # a host of its own
        return 302, b"", {**headers, "X-Linked-Etag": f'"{oid}"', "X-Linked-Size": len(content), "Location": place}

    def get_large(self, oid):
        return 200, self.server.large[oid]


NAME = r"([\w.-]+/[\w.-]+)"
ROUTES = {
    "POST /api/repos/create": Handler.create,
    "POST /api/validate-yaml": Handler.validate,
    rf"GET /api/models/{NAME}": Handler.info,
    rf"GET /api/models/{NAME}/revision/(.+)": Handler.info,
    rf"GET /api/models/{NAME}/tree/(.+)": Handler.tree,
    rf"POST /api/models/{NAME}/preupload/(.+)": Handler.preupload,
    rf"POST /api/models/{NAME}/commit/(.+)": Handler.commit,
    rf"POST /{NAME}\.git/info/lfs/objects/batch": Handler.batch,
    "PUT /large/(.+)": Handler.put,
    "(?:GET|HEAD) /large/(.+)": Handler.get_large,
    rf"(?:GET|HEAD) /{NAME}/resolve/([^/]+)/(.+)": Handler.resolve,
}


@contextmanager
def serving():
    """A Hub that answers while the block runs."""
    with Hub() as hub:
        threading.Thread(target=hub.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        try:
            yield hub
        finally:
            hub.shutdown()
