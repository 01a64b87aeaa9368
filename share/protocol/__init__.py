"""Agent and edge as state machines: events in, effects out; `agent.AgentProtocol.handle`,
`edge.EdgeProtocol.handle`.

`share.runtime.agent` and `share.runtime.served_room` carry the effects out;
`share.lab.evaluate.simulation` runs the same machines in virtual time.
"""
