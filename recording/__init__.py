"""Recordings of runs: one SQLite database per run, MCAP files of all messages, and playing back.

Database of a run:
    tables             columns of every table, once; `SCHEMA_VERSION`
    rows               messages as rows of the tables
    latency_breakdown  where the time of a frame went, by agent and stage
    frame_aggregator   the last frames, aggregated from the messages of all processes
    losses             messages dropped, gaps while a bus was away
    database           writes the database
    role               the record role: subscribes, aggregates, writes
    run                reads run folders, compares the results of two
    limits             bounds on messages and files of others
    config             scenario sections `record` and `replay`
All messages:
    mcap               MCAP files: writer, reader, conversion for Foxglove (extra `mcap`)
    playback           publishes a recording in the place of the world and the agents
    foreign_scans      folders of scans from elsewhere as recordings
"""
