"""The processes, their threads and queues: `agent.AgentRun`, `edge.EdgeRun` with its `served_room` (in it a
`room_session`), `mapper_process`.

Without an edge: `offline_tracking.track`.

Everything that decides is below, in `share.protocol`, `share.mapping` and `share.odometry`.
"""
