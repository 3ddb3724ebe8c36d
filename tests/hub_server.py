"""A Hub on this machine: the end points that huggingface_hub needs, over real HTTP, with faults on demand.

    python tests/hub_server.py          # prints HF_ENDPOINT=..., serves until it is ended

Repositories live in memory. A token `hf_NAME` belongs to the user NAME, who may write to `NAME/...` only. Every file is
"regular" to the Hub's client: it travels inside the commit, without LFS or Xet.
"""

from __future__ import annotations

import base64
import fnmatch
import hashlib
import json
import re
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit


@dataclass
class Fault:
    """What goes wrong with requests whose "METHOD /path" matches `pattern`.

    Attributes:
        pattern: a regular expression.
        status: answer with this HTTP status; 0 to answer as usual.
        delay_s: wait before answering.
        cut: close the connection in the middle of the answer, or instead of one.
        drip_s: send a byte of the answer, its headers among them, and wait so long before the next.
        times: how often; the next request is answered as usual.
        headers: of the answer, for `status`.
        hits: how often it has happened.
    """

    pattern: str
    status: int = 0
    delay_s: float = 0.0
    cut: bool = False
    drip_s: float = 0.0
    times: int = 1_000_000
    headers: dict[str, str] = field(default_factory=dict)
    hits: int = 0

    def strikes(self, request: str) -> bool:
        """Whether it happens to this request."""
        hit = self.hits < self.times and re.search(self.pattern, request) is not None
        self.hits += hit
        return hit


@dataclass
class Repo:
    """A repository: snapshots by commit, and names for commits.

    Attributes:
        name: `user/name`.
        kind: `models` or `datasets`.
        commits: files of each commit.
        refs: commits by branch.
        tags: commits by tag.
    """

    name: str
    kind: str
    private: bool
    commits: dict[str, dict[str, bytes]] = field(default_factory=dict)
    refs: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)

    def commit(self, files: dict[str, bytes], branch: str = "main") -> str:
        """A new commit of these files on a branch."""
        content = json.dumps([self.name, len(self.commits), sorted((p, _blob_id(b)) for p, b in files.items())])
        oid = hashlib.sha1(content.encode()).hexdigest()
        self.commits[oid] = files
        self.refs[branch] = oid
        return oid

    def resolve(self, revision: str) -> str | None:
        """The commit of a branch, tag or commit."""
        if revision in self.commits:
            return revision
        return self.refs.get(revision) or self.tags.get(revision)

    @property
    def files(self) -> dict[str, bytes]:
        """Of the newest commit."""
        return self.commits[self.refs["main"]]


class Hub(ThreadingHTTPServer):
    """The server.

    Args:
        listener: a bound socket; None for any free port.

    Attributes:
        repos: by kind and name.
        faults: the first that strikes is what happens.
        requests: "METHOD /path" of all so far.
        hooks: called with the commit's repository before a commit is made; for conflicts.
    """

    daemon_threads = True

    def __init__(self, listener: socket.socket | None = None) -> None:
        super().__init__(("127.0.0.1", 0), _Handler, bind_and_activate=False)
        self.socket.close()
        self.socket = listener or socket.create_server(("127.0.0.1", 0))
        self.socket.listen(64)
        self.server_address = self.socket.getsockname()
        self.clear()

    @property
    def url(self) -> str:
        """For HF_ENDPOINT."""
        return f"http://127.0.0.1:{self.server_address[1]}"

    def clear(self) -> None:
        """Forget everything."""
        self.repos: dict[tuple[str, str], Repo] = {}
        self.faults: list[Fault] = []
        self.requests: list[str] = []
        self.hooks: list[Callable[[Repo], None]] = []

    def repo(self, name: str, kind: str = "models") -> Repo:
        """A repository that exists."""
        return self.repos[kind, name]

    def create(self, name: str, kind: str = "models", files: dict[str, bytes] | None = None) -> Repo:
        """A new repository with files of any name, also names that the client would refuse."""
        repo = self.repos[kind, name] = Repo(name, kind, private=False)
        repo.commit({".gitattributes": b"", **(files or {})})
        return repo

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that went away is no news."""


class _Refusal(Exception):
    """An HTTP error to answer with."""

    def __init__(self, status: int, code: str = "", message: str = "") -> None:
        super().__init__(message)
        self.status, self.headers = status, {"X-Error-Code": code, "X-Error-Message": message or code}


class _Dripping:
    """A file that is written byte by byte."""

    def __init__(self, file: Any, wait_s: float) -> None:
        self._file, self._wait_s = file, wait_s

    def write(self, data: bytes) -> None:
        for byte in data:
            self._file.write(bytes([byte]))
            self._file.flush()
            time.sleep(self._wait_s)

    def flush(self) -> None:
        self._file.flush()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Hub

    def log_message(self, *arguments: Any) -> None:
        """Tests are quiet."""

    def _serve(self) -> None:
        split = urlsplit(self.path)
        self.route, self.query = split.path, parse_qs(split.query)
        self.body = self.rfile.read(int(self.headers.get("Content-Length") or 0)) or self._read_chunks()
        request = f"{self.command} {unquote(self.route)}"
        self.server.requests.append(request)
        fault = next((fault for fault in self.server.faults if fault.strikes(request)), Fault(""))
        self.cut = fault.cut
        plain, self.wfile = self.wfile, _Dripping(self.wfile, fault.drip_s) if fault.drip_s else self.wfile
        time.sleep(fault.delay_s)
        try:
            if fault.status:
                self._send(fault.status, b"", {"X-Error-Message": "injected fault", **fault.headers})
            else:
                self._answer()
        except _Refusal as refusal:
            message = json.dumps({"error": str(refusal)}).encode()
            self._send(refusal.status, message, refusal.headers)
        finally:
            self.wfile = plain

    do_GET = do_HEAD = do_POST = do_DELETE = do_PUT = _serve

    def _read_chunks(self) -> bytes:
        """The body of a request with `Transfer-Encoding: chunked`."""
        body = b""
        if self.headers.get("Transfer-Encoding") == "chunked":
            while size := int(self.rfile.readline(), 16):
                body += self.rfile.read(size)
                self.rfile.readline()
            self.rfile.readline()
        return body

    def _send(self, status: int, body: bytes, headers: dict[str, str] | None = None) -> None:
        self.send_response(status)
        for name, value in {"Content-Length": str(len(body)), **(headers or {})}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.cut:
            self.wfile.write(body[: len(body) // 2])
            self.close_connection = True
            self.connection.shutdown(socket.SHUT_RDWR)
        elif self.command != "HEAD":
            self.wfile.write(body)

    def _json(self, data: Any) -> None:
        self._send(200, json.dumps(data).encode(), {"Content-Type": "application/json"})

    # --- What is asked ------------------------------------------------------------------------------------
    def _answer(self) -> None:
        match = re.fullmatch(r"/api/(models|datasets)/([^/]+/[^/]+)(?:/([a-z-]+)(?:/([^/]+)(?:/(.*))?)?)?", self.route)
        if self.route == "/api/whoami-v2":
            self._json({"type": "user", "name": self._user(), "fullname": self._user(), "orgs": [], "auth": {}})
        elif self.route == "/api/validate-yaml":
            self._json({"errors": [], "warnings": []})
        elif self.route == "/api/repos/create":
            self._create()
        elif match is not None:
            kind, name, verb, revision, rest = (part and unquote(part) for part in match.groups())
            self._api(self._find(kind, name), verb or "info", revision or "main", rest or "")
        else:
            self._resolve()

    def _user(self) -> str:
        token = self.headers.get("Authorization", "").removeprefix("Bearer ")
        if not token.startswith("hf_"):
            raise _Refusal(401, message="Invalid username or password.")
        return token.removeprefix("hf_")

    def _find(self, kind: str, name: str) -> Repo:
        repo = self.server.repos.get((kind, name))
        authorized = self.headers.get("Authorization", "") == f"Bearer hf_{name.split('/')[0]}"
        if repo is None or (repo.private and not authorized):
            raise _Refusal(404 if "Authorization" in self.headers else 401, "RepoNotFound", "Repository not found")
        return repo

    def _create(self) -> None:
        asked = json.loads(self.body)
        owner = asked.get("organization") or self._user()
        if owner != self._user():
            raise _Refusal(403, message=f"You don't have the rights to create a model under the namespace {owner}")
        kind, name = f"{asked.get('type', 'model')}s", f"{owner}/{asked['name']}"
        prefix = "datasets/" if kind == "datasets" else ""
        url = {"url": f"{self.server.url}/{prefix}{name}"}
        if (kind, name) in self.server.repos:
            self._send(409, json.dumps(url).encode(), {"Content-Type": "application/json"})
            return
        repo = self.server.create(name, kind)
        repo.private = asked.get("visibility") == "private"
        self._json(url)

    def _api(self, repo: Repo, verb: str, revision: str, rest: str) -> None:
        if self.command in ("POST", "DELETE") and verb in ("commit", "tag", "preupload"):
            self._check_writer(repo)
        if verb in ("info", "revision"):
            self._info(repo, revision)
        elif verb == "refs":
            named = {"branches": repo.refs, "tags": repo.tags, "converts": {}}
            self._json({k: [_ref(n, oid, k) for n, oid in refs.items()] for k, refs in named.items()})
        elif verb == "tag":
            self._tag(repo, revision)
        elif verb == "preupload":
            self._preupload(repo, revision)
        elif verb == "commit":
            self._commit(repo, revision)
        elif verb == "paths-info":
            files = self._files(repo, revision)
            wanted = json.loads(self.body) if self.body.startswith(b"{") else parse_qs(self.body.decode())
            entries = [entry for path in wanted["paths"] for entry in _tree(files, "", True) if entry["path"] == path]
            self._json(entries)
        elif verb == "tree":
            recursive = self.query.get("recursive", ["false"])[0].lower() in ("true", "1")
            self._json(_tree(self._files(repo, revision), rest, recursive))
        else:
            raise _Refusal(404, message=f"this Hub has no {verb}")

    def _check_writer(self, repo: Repo) -> None:
        if self._user() != repo.name.split("/")[0]:
            raise _Refusal(403, message="You don't have write access to this repository")

    def _files(self, repo: Repo, revision: str) -> dict[str, bytes]:
        oid = repo.resolve(revision)
        if oid is None:
            raise _Refusal(404, "RevisionNotFound", f"Invalid rev id: {revision}")
        return repo.commits[oid]

    def _info(self, repo: Repo, revision: str) -> None:
        files = self._files(repo, revision)
        siblings = [{"rfilename": path, "size": len(files[path])} for path in sorted(files)]
        about = {"id": repo.name, "sha": repo.resolve(revision), "private": repo.private, "tags": [], "gated": False}
        self._json({**about, "siblings": siblings, "disabled": False, "downloads": 0, "likes": 0})

    def _tag(self, repo: Repo, revision: str) -> None:
        if self.command == "DELETE":
            if repo.tags.pop(revision, None) is None:
                raise _Refusal(404, "RevisionNotFound", "no such tag")
        else:
            tag = json.loads(self.body)["tag"]
            if tag in repo.tags:
                raise _Refusal(409, message="Tag already exists")
            self._files(repo, revision)
            repo.tags[tag] = repo.resolve(revision) or ""
        self._json({})

    def _preupload(self, repo: Repo, revision: str) -> None:
        have = self._files(repo, revision)
        asked = [file["path"] for file in json.loads(self.body)["files"]]
        oids = {path: _blob_id(have[path]) if path in have else None for path in asked}
        files = [{"path": p, "uploadMode": "regular", "shouldIgnore": False, "oid": oids[p]} for p in asked]
        self._json({"files": files})

    def _commit(self, repo: Repo, branch: str) -> None:
        for hook in self.server.hooks:
            hook(repo)
        files = dict(self._files(repo, branch))
        for line in self.body.splitlines():
            item = json.loads(line)
            key, value = item["key"], item["value"]
            if key == "header" and value.get("parentCommit") not in (None, repo.refs[branch]):
                raise _Refusal(412, message="A commit has happened since. Please refresh and try again.")
            if key == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif key == "deletedFile":
                files.pop(value["path"], None)
            elif key == "deletedFolder":
                files = {path: data for path, data in files.items() if not fnmatch.fnmatch(path, value["path"] + "*")}
        oid = repo.commit(files, branch)
        self._json({"commitOid": oid, "commitUrl": f"{self.server.url}/{repo.name}/commit/{oid}", "success": True})

    def _resolve(self) -> None:
        match = re.fullmatch(r"/(datasets/)?([^/]+/[^/]+)/resolve/([^/]+)/(.*)", self.route)
        if match is None:
            raise _Refusal(404, message=f"this Hub has no {self.route}")
        dataset, name, revision, path = (part and unquote(part) for part in match.groups())
        repo = self._find("datasets" if dataset else "models", name)
        files = self._files(repo, revision)
        headers = {"X-Repo-Commit": repo.resolve(revision) or "", "Accept-Ranges": "bytes"}
        if path not in files:
            raise _Refusal(404, "EntryNotFound", "Entry not found")
        headers["ETag"] = f'"{_blob_id(files[path])}"'
        if wanted := re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", "")):
            first = int(wanted[1])
            part = files[path][first : int(wanted[2]) + 1 if wanted[2] else None]
            where = f"bytes {first}-{first + len(part) - 1}/{len(files[path])}"
            self._send(206, part, {**headers, "Content-Range": where})
        elif self.command == "HEAD":
            self._send(200, b"", {**headers, "Content-Length": str(len(files[path]))})
        else:
            self._send(200, files[path], headers)


def _blob_id(data: bytes) -> str:
    """As git names it; the client compares it with its own files to skip what has not changed."""
    return hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()


def _ref(name: str, oid: str, kind: str) -> dict[str, str]:
    prefix = "refs/tags/" if kind == "tags" else "refs/heads/"
    return {"name": name, "ref": prefix + name, "targetCommit": oid}


def _tree(files: dict[str, bytes], folder: str, recursive: bool) -> list[dict[str, Any]]:
    """Entries below a folder, folders among them."""
    prefix = f"{folder}/" if folder else ""
    entries: dict[str, dict[str, Any]] = {}
    for path, data in sorted(files.items()):
        if not path.startswith(prefix):
            continue
        parts = path.removeprefix(prefix).split("/")
        for depth in range(1, len(parts)):
            name = prefix + "/".join(parts[:depth])
            entries[name] = {"type": "directory", "oid": _blob_id(name.encode()), "size": 0, "path": name}
        entries[path] = {"type": "file", "oid": _blob_id(data), "size": len(data), "path": path}
    if not recursive:
        entries = {path: entry for path, entry in entries.items() if "/" not in path.removeprefix(prefix)}
    if folder and not entries:
        raise _Refusal(404, "EntryNotFound", "Entry not found")
    return list(entries.values())


if __name__ == "__main__":
    hub = Hub()
    print(f"HF_ENDPOINT={hub.url}", flush=True)
    hub.serve_forever()
