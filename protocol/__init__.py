"""All that crosses a process boundary: messages, topics, wire format, scan codec, buses.

`topics`            the topic table: key, message, bus, delivery, publishers, subscribers
`messages/`         every message; its base and field types in `messages/fields.py`
`wire`              messages as bytes: prefix, msgpack header, arrays
`limits`            bounds on what others may send
`codec/`            scans as bytes within an error bound; `scans` holds scans, clouds, profiles
`bus`, `in_process` the buses over Zenoh and within one process; `inbox` queues what arrives
`observer`          attaches to a run from outside; the frame buffer of its messages
`access`            certificates, and who may publish and subscribe to what
`process`           the life of a role's process; `logs`, `version`, `plugins`, `config` and
                    `extras` serve it
`starting`          what whoever starts processes needs
`clock`             offsets between the clocks of machines
`sequence_window`   which frame numbers can be real
`tcpinfo`           the kernel's counters of a connection
`geometry`          rigid transforms; `roadmap` lanes and signal
`errors`            the exception tree
"""
