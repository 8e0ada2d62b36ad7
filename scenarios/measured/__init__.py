"""Real pictures with measured attitudes and altitudes, ingested from a user's folder (docs/real-pictures.md).

`layout` says what such a folder holds, `table` and `picture_files` read it, `ingest` holds it against its task and
writes it down as `store` has it. `matching`, `descent` and `landing` are the scenarios of the three tasks;
`consistency` tells how pictures and poses agree, with or without truth. Nothing is imported here: a folder is read
without any algorithm.
"""
