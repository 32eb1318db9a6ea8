"""Communication between processes: messages, topics, wire format, scan codec, Zenoh buses.

`topics`            the topic table: key, message, bus, delivery, publishers, subscribers
`messages/`         every message; its base and field types in `messages/fields.py`
`wire`              messages as bytes: prefix, msgpack header, arrays
`limits`            limits on the size and value of received data
`codec/`            scan compression within an error bound; `scans` holds scans, clouds, profiles
`bus`, `in_process` the buses over Zenoh and within one process; `inbox` queues received messages
`observer`          attaches to a run from outside; the frame buffer of its messages
`access`            certificates, and who may publish and subscribe to what
`process`           the life of a role's process; `logs`, `version`, `plugins`, `config` and
                    `extras` serve it
`starting`          helpers for code that starts processes
`clock`             offsets between the clocks of machines
`sequence_window`   the window of plausible frame numbers
`tcpinfo`           the kernel's counters of a connection
`geometry`          rigid transforms; `roadmap` lanes and signal
`errors`            the exception tree
"""
