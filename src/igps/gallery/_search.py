"""The rows of a gallery that are closest to a query.

A search has two steps. The compressed short vectors of all rows give the nearest few hundred candidates (see
`igps.gallery._codes`). The candidates are ranked by the distance between full descriptions.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from igps._threads import one_thread
from igps.retrieval.distances import Distance

if TYPE_CHECKING:
    from igps.gallery._table import BodyTable  # needs LanceDB


@one_thread()
def nearest_rows(
    table: "BodyTable",
    query: Tensor,
    distance: Distance,
    *,
    top: int,
    candidates: int = 512,
    exact: bool = False,
    where: str | None = None,
) -> tuple[list[dict[str, Any]], Tensor, Tensor]:
    """Return the rows closest to a query (1, ...), their distances (M,) and descriptions (M, ...), M ≤ top.

    Ties are ordered by id. Only the max(candidates, 2 * top) rows that are nearest by their codes are compared, or
    all rows if `exact` is set or the table has no codes.
    """
    table.check_shape(query)
    groups = table.batches(where, ("_rowid", "vector"))
    if not exact and (codes := table.code_index()) is not None:
        among = None if where is None else table.with_row_ids(where)["_rowid"].to_numpy()
        near = codes.nearest(
            query.reshape(-1).cpu().float().numpy(), max(candidates, 2 * top), among
        )
        groups = iter([table.take(near, "vector")] if len(near) else [])
    ids, distances, nearest = np.zeros(0, np.uint64), torch.zeros(0), torch.zeros(0, *table.shape)
    for group in groups:
        ids, nearest = (
            np.append(ids, group["_rowid"].to_numpy()),
            torch.cat([nearest, table.descriptions(group)]),
        )
        distances = distance(query, nearest.to(query.device)).cpu()[0]
        best = distances <= distances.kthvalue(min(top, len(ids))).values
        ids, distances, nearest = ids[best.numpy()], distances[best], nearest[best]
    by_id = {
        row.pop("_rowid"): row
        for row in (table.take(ids, *table.columns).to_pylist() if len(ids) else ())
    }
    rows = [by_id[row_id] for row_id in ids.tolist()]
    order = np.lexsort(([row["id"] for row in rows], distances.numpy()))[:top]
    return [rows[i] for i in order], distances[order], nearest[order]
