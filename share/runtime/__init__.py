"""The processes, their threads and queues: `agent.AgentRun`, `edge.EdgeRun`, `mapper_process`.

Without an edge: `offline_tracking.track`.

Everything that decides is below, in `share.protocol`, `share.mapping` and `share.odometry`.
"""
