"""Recordings of runs: one SQLite database per run, MCAP files of all messages, and playback.

Database of a run:
    tables             columns of every table, once; `SCHEMA_VERSION`
    rows               messages as rows of the tables
    latency_breakdown  latency of a frame, by agent and stage
    frame_aggregator   the last frames, aggregated from the messages of all processes
    losses             messages dropped, gaps while a bus was away
    database           writes the database
    role               the record role: subscribes, aggregates, writes
    run                reads run folders, compares the results of two
    limits             bounds on received messages and files
    config             scenario sections `record` and `replay`
All messages:
    mcap               MCAP files: writer, reader, conversion for Foxglove (extra `mcap`)
    playback           replays a recording instead of the world and the agents
    foreign_scans      converts folders of scans from other sources to recordings
"""
