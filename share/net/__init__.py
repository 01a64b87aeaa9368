"""Links between agents and edge over ZeroMQ: sockets, guards, keys; UDP and NTP for clocks."""
