"""A data set can be verified by what the contract's page says of its checksums alone."""

import hashlib
import json

from nvsf_core.stages.exports.manifest import write_manifest
from nvsf_core.stores.checksums import file_checksums
from nvsf_core.stores.contract_page import as_markdown


def test_a_files_checksum_is_the_one_that_the_page_gives(tmp_path):
    (tmp_path / "a.txt").write_bytes(b"123456789")
    assert file_checksums(tmp_path) == {"a.txt": "9-cbf43926"}
    assert "CRC-32 in hex as zlib's, `9-cbf43926` for `123456789`" in as_markdown()


def test_a_manifests_own_digest_is_the_one_that_the_page_gives(tmp_path):
    write_manifest(tmp_path, {"licence": "für alle", "checksums": {"a.txt": "9-cbf43926"}, "number": 0.1})
    others = json.loads((tmp_path / "manifest.json").read_text())
    own = others.pop("manifest_sha256")
    assert own == hashlib.sha256(json.dumps(others, sort_keys=True).encode()).hexdigest()
    assert "SHA-256 of `json.dumps` of all other entries with `sort_keys=True`" in as_markdown()
