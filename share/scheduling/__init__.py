"""Scheduling: QoE of each agent, keyframe rates by policy, the merge gate
(docs/understand/scheduling.md).
"""
