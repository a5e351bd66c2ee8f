//! Benches one behind the other form lines.

use super::{Doubt, FusedBench, FusionParams, OpenDoubt};
use nalgebra::Vector2;
use serde::{Deserialize, Serialize};

/// A line: its benches from the west.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FusedLine {
    /// Indices into the benches.
    pub benches: Vec<usize>,
}

/// A bench in the horizontal plane.
struct Footprint {
    along: Vector2<f64>,
    across: Vector2<f64>,
    west: Vector2<f64>,
    east: Vector2<f64>,
    /// Half its extent across, metres.
    half_m: f64,
}

impl Footprint {
    fn of(bench: &FusedBench) -> Self {
        let along = bench.pitch_m[0].normalize();
        let across = Vector2::new(along.y, -along.x);
        let half_m = bench.pitch_m[1].dot(&across).abs() * f64::from(bench.rows) / 2.0;
        // The middle of the lattice, not of the modules: holes must not pull it aside.
        let lattice_middle = Vector2::new(f64::from(bench.cols - 1) / 2.0, f64::from(bench.rows - 1) / 2.0);
        let count = bench.modules.len() as f64;
        let mean = bench.modules.iter().map(|m| Vector2::new(f64::from(m.col), f64::from(m.row))).sum::<Vector2<f64>>()
            / count;
        let off = lattice_middle - mean;
        let middle = bench.middle_m.xy() + bench.pitch_m[0] * off.x + bench.pitch_m[1] * off.y;
        let reach = bench.pitch_m[0] * (f64::from(bench.cols) / 2.0);
        Self { along, across, west: middle - reach, east: middle + reach, half_m }
    }
}

/// Groups benches into lines and sorts both: lines from the north, benches from the west (where rows run north-south:
/// lines from the east, benches from the north).
pub(super) fn arrange(
    benches: Vec<FusedBench>,
    params: &FusionParams,
    doubts: &mut Vec<OpenDoubt>,
) -> (Vec<FusedLine>, Vec<FusedBench>) {
    let footprints: Vec<Footprint> = benches.iter().map(Footprint::of).collect();
    let Pairs { facing, doubtful } = pairs(&footprints, params);
    let mut next = vec![None; benches.len()];
    let mut previous = vec![None; benches.len()];
    for (_, i, j) in facing {
        if next[i].is_none() && previous[j].is_none() {
            next[i] = Some(j);
            previous[j] = Some(i);
        }
    }
    let touching = |(i, next): (usize, &Option<usize>)| next.map(|j| (i, j));
    let joined: Vec<(usize, usize)> = next.iter().enumerate().filter_map(touching).collect();
    doubts.extend(joined.into_iter().filter_map(|(i, j)| bench_or_hole(&benches[i], &benches[j], params)));
    doubts.extend(
        doubtful
            .into_iter()
            .filter(|&(i, j)| next[i].is_none() && previous[j].is_none())
            .map(|(i, j)| line_unsure(&benches[i], &benches[j])),
    );
    let lines = chains(&next, &previous);
    sorted(lines, benches, &footprints)
}

/// Benches that face each other by their ends, the western one first.
struct Pairs {
    /// With what speaks against it, metres; the surest first.
    facing: Vec<(f64, usize, usize)>,
    /// By the corners of their ends alone.
    doubtful: Vec<(usize, usize)>,
}

fn pairs(footprints: &[Footprint], params: &FusionParams) -> Pairs {
    let cell_m = params.line_gap_m;
    let key = |p: Vector2<f64>| ((p.x / cell_m).floor() as i64, (p.y / cell_m).floor() as i64);
    let mut wests: std::collections::HashMap<(i64, i64), Vec<usize>> = std::collections::HashMap::new();
    for (index, footprint) in footprints.iter().enumerate() {
        wests.entry(key(footprint.west)).or_default().push(index);
    }
    let mut pairs = Pairs { facing: Vec::new(), doubtful: Vec::new() };
    for (i, from) in footprints.iter().enumerate() {
        let home = key(from.east);
        for (dx, dy) in (-2..=2).flat_map(|dx| (-2..=2).map(move |dy| (dx, dy))) {
            for &j in wests.get(&(home.0 + dx, home.1 + dy)).into_iter().flatten() {
                let to = &footprints[j];
                if i == j || from.along.angle(&to.along) > params.line_bend_deg.to_radians() {
                    continue;
                }
                let offset = to.west - from.east;
                let (gap, aside) = (offset.dot(&from.along), offset.dot(&from.across));
                let within = |share: f64| aside.abs() < share * (from.half_m + to.half_m) + 0.05 * gap;
                if !(-1.0..params.line_gap_m).contains(&gap) {
                    continue;
                }
                if within(params.line_aside) {
                    pairs.facing.push((gap.max(0.0) + 2.0 * aside.abs(), i, j));
                } else if within(params.line_doubtful_aside) {
                    pairs.doubtful.push((i, j));
                }
            }
        }
    }
    pairs.facing.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    pairs.doubtful.sort_unstable();
    pairs
}

/// Benches one behind the other, from the first of each line; where they run in a circle, from any.
fn chains(next: &[Option<usize>], previous: &[Option<usize>]) -> Vec<Vec<usize>> {
    let count = next.len();
    let mut seen = vec![false; count];
    let mut lines: Vec<Vec<usize>> = Vec::new();
    for start in (0..count).filter(|k| previous[*k].is_none()).chain(0..count) {
        let mut line = Vec::new();
        let mut at = Some(start);
        while let Some(bench) = at.filter(|bench| !seen[*bench]) {
            seen[bench] = true;
            line.push(bench);
            at = next[bench];
        }
        if !line.is_empty() {
            lines.push(line);
        }
    }
    lines
}

/// Lines and benches in one order for the whole plant: across the rows of most modules.
fn sorted(
    lines: Vec<Vec<usize>>,
    benches: Vec<FusedBench>,
    footprints: &[Footprint],
) -> (Vec<FusedLine>, Vec<FusedBench>) {
    let across = footprints
        .iter()
        .zip(&benches)
        .map(|(footprint, bench)| footprint.across * bench.modules.len() as f64)
        .sum::<Vector2<f64>>()
        .try_normalize(1e-9)
        .unwrap_or(Vector2::new(0.0, -1.0));
    let place = |line: &Vec<usize>| {
        let (mut sum, mut weight) = (0.0, 0.0);
        for &bench in line {
            let modules = benches[bench].modules.len() as f64;
            sum += benches[bench].middle_m.xy().dot(&across) * modules;
            weight += modules;
        }
        sum / weight
    };
    let mut placed: Vec<(f64, Vec<usize>)> = lines.into_iter().map(|line| (place(&line), line)).collect();
    placed.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let order: Vec<usize> = placed.iter().flat_map(|(_, line)| line.iter().copied()).collect();
    let mut new_index = vec![0; benches.len()];
    for (new, old) in order.iter().enumerate() {
        new_index[*old] = new;
    }
    let lines = placed
        .into_iter()
        .map(|(_, line)| FusedLine { benches: line.into_iter().map(|bench| new_index[bench]).collect() })
        .collect();
    let mut slots: Vec<Option<FusedBench>> = benches.into_iter().map(Some).collect();
    let sorted = order.into_iter().filter_map(|old| slots[old].take()).collect();
    (lines, sorted)
}

/// Two benches that may be of one line, or of two lines beside each other.
fn line_unsure(west: &FusedBench, east: &FusedBench) -> OpenDoubt {
    let (from, to) = (west.middle_m.xy(), east.middle_m.xy());
    let doubt = Doubt {
        code: "line_unsure".into(),
        message: format!(
            "the benches at {:.1} m east, {:.1} m north and {:.1} m east, {:.1} m north face each other by the corners of \
             their ends alone: they are taken as of two lines, but may be of one",
            from.x, from.y, to.x, to.y
        ),
        images: Vec::new(),
        benches: Vec::new(),
        sightings: Vec::new(),
        places_m: vec![from, to],
    };
    OpenDoubt { doubt, clusters: vec![west.cluster, east.cluster] }
}

/// Two benches that one lattice fits, with empty columns between them: they may be one bench whose modules are missing
/// there.
fn bench_or_hole(west: &FusedBench, east: &FusedBench, params: &FusionParams) -> Option<OpenDoubt> {
    if west.rows != east.rows {
        return None;
    }
    // The lattice origin of the eastern bench in columns and rows of the western one.
    let corner = |bench: &FusedBench| {
        let count = bench.modules.len() as f64;
        let mean = bench.modules.iter().map(|m| Vector2::new(f64::from(m.col), f64::from(m.row))).sum::<Vector2<f64>>()
            / count;
        bench.middle_m.xy() - bench.pitch_m[0] * mean.x - bench.pitch_m[1] * mean.y
    };
    let [u, v] = west.pitch_m;
    let area = u.perp(&v);
    let offset = corner(east) - corner(west);
    let (column, row) = (offset.perp(&v) / area, u.perp(&offset) / area);
    let empty = column - f64::from(west.cols);
    let whole = empty.round();
    let on_lattice = (empty - whole).abs() < params.hole_off_lattice && row.abs() < params.hole_off_lattice;
    (on_lattice && (1.0..=params.hole_most_columns).contains(&whole)).then(|| {
        let middles = [west.middle_m.xy(), east.middle_m.xy()];
        let doubt = Doubt {
            code: "bench_or_hole".into(),
            message: format!(
                "the benches at {:.1} m east, {:.1} m north and {:.1} m east, {:.1} m north stand on one lattice with \
                 {whole} empty columns between them: they are taken as two benches, but may be one whose modules are \
                 missing there",
                middles[0].x, middles[0].y, middles[1].x, middles[1].y
            ),
            images: Vec::new(),
            benches: Vec::new(),
            sightings: Vec::new(),
            places_m: middles.to_vec(),
        };
        OpenDoubt { doubt, clusters: vec![west.cluster, east.cluster] }
    })
}
