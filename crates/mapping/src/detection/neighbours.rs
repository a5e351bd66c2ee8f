//! Points in the image by place, for questions about neighbours.

use nalgebra::Vector2;

/// Indices of points in square cells, so that asking for neighbours costs what they are and not what all are.
pub(super) struct Grid {
    cell_px: f64,
    origin: Vector2<f64>,
    columns: usize,
    rows: usize,
    /// First entry of each cell in `entries`, and one past the last.
    starts: Vec<usize>,
    entries: Vec<usize>,
    points: Vec<Vector2<f64>>,
}

impl Grid {
    /// Cells of about `cell_px` pixels over finite points; larger ones where there would be far more cells than points.
    pub fn new(points: Vec<Vector2<f64>>, cell_px: f64) -> Self {
        let origin = points.iter().copied().reduce(|a, b| a.inf(&b)).unwrap_or_default();
        let extent = points.iter().copied().reduce(|a, b| a.sup(&b)).unwrap_or_default() - origin;
        let least = (extent.x * extent.y / (4.0 * points.len().max(1) as f64)).sqrt();
        let longest = extent.x.max(extent.y) / 4096.0;
        let cell_px = cell_px.max(least).max(longest).max(1e-9);
        let columns = (extent.x / cell_px) as usize + 1;
        let rows = (extent.y / cell_px) as usize + 1;
        let cell_of = |p: &Vector2<f64>| {
            let at = (p - origin) / cell_px;
            (at.y as usize).min(rows - 1) * columns + (at.x as usize).min(columns - 1)
        };
        let mut starts = vec![0; columns * rows + 1];
        for point in &points {
            starts[cell_of(point) + 1] += 1;
        }
        for cell in 0..columns * rows {
            starts[cell + 1] += starts[cell];
        }
        let mut next = starts.clone();
        let mut entries = vec![0; points.len()];
        for (index, point) in points.iter().enumerate() {
            let slot = &mut next[cell_of(point)];
            entries[*slot] = index;
            *slot += 1;
        }
        Self { cell_px, origin, columns, rows, starts, entries, points }
    }

    /// Index and squared distance (square pixels) of every point within `radius_px` of `place`, always in the same
    /// order.
    pub fn within(&self, place: Vector2<f64>, radius_px: f64) -> impl Iterator<Item = (usize, f64)> + '_ {
        let range = |value: f64, count: usize| {
            let from = ((value - radius_px) / self.cell_px).floor().clamp(0.0, count as f64) as usize;
            let to = ((value + radius_px) / self.cell_px + 1.0).floor().clamp(0.0, count as f64) as usize;
            from..to
        };
        let relative = place - self.origin;
        let columns = range(relative.x, self.columns);
        range(relative.y, self.rows)
            .flat_map(move |row| {
                let first = self.starts[row * self.columns + columns.start];
                let last = self.starts[row * self.columns + columns.end.max(columns.start)];
                &self.entries[first..last]
            })
            .map(move |&index| (index, (self.points[index] - place).norm_squared()))
            .filter(move |(_, distance2)| *distance2 <= radius_px * radius_px)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn finds_what_a_search_through_all_finds(
            points in prop::collection::vec((-50.0..200.0_f64, -20.0..90.0_f64), 0..60),
            place in (-80.0..230.0_f64, -50.0..120.0_f64),
            radius in 0.1..80.0_f64,
            cell in 0.5..40.0_f64,
        ) {
            let points: Vec<Vector2<f64>> = points.into_iter().map(|(x, y)| Vector2::new(x, y)).collect();
            let place = Vector2::new(place.0, place.1);
            let grid = Grid::new(points.clone(), cell);
            let mut found: Vec<usize> = grid.within(place, radius).map(|(index, _)| index).collect();
            found.sort_unstable();
            let expected: Vec<usize> =
                (0..points.len()).filter(|&i| (points[i] - place).norm_squared() <= radius * radius).collect();
            prop_assert_eq!(found, expected);
        }
    }
}
