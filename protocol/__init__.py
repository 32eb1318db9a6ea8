"""All that crosses a process boundary: messages, topics, wire, codec, geometry, bus."""
