"""Agent and edge as state machines: events in, effects out; `agent.Agent.handle`, `edge.Edge.handle`.

`share.runtime.agent` and `share.runtime.edge` carry the effects out; `share.lab.evaluate.simulation` runs
the same machines in virtual time.
"""
