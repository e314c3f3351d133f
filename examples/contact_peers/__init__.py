"""One task on Drake's own contact, by our law and by what users would do today.

`python -m contact_peers` from `examples/` measures each law on each plant, and writes the table and
the picture; `make peers` does so from the top. See `table.md`.
"""
