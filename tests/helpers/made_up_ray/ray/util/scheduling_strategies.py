def NodeAffinitySchedulingStrategy(node: str, soft: bool) -> str:
    return node
