//! Vectors of three numbers, rotations, and five equations.

pub(super) type Vector = [f64; 3];
pub(super) type Matrix = [Vector; 3];

/// How far a rotation turns, in degrees.
pub(super) fn degrees(rotation: &Matrix) -> f64 {
    let trace = rotation[0][0] + rotation[1][1] + rotation[2][2];
    // The sine is exact where the cosine is not: at small angles.
    let twist = [rotation[2][1] - rotation[1][2], rotation[0][2] - rotation[2][0], rotation[1][0] - rotation[0][1]];
    (dot(twist, twist).sqrt() / 2.0).atan2((trace - 1.0) / 2.0).to_degrees()
}

pub(super) fn dot(a: Vector, b: Vector) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(super) fn cross(a: Vector, b: Vector) -> Vector {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

pub(super) fn unit(a: Vector) -> Vector {
    let length = dot(a, a).sqrt().max(1e-300);
    a.map(|x| x / length)
}

pub(super) fn apply(m: &Matrix, v: Vector) -> Vector {
    m.map(|row| dot(row, v))
}

pub(super) fn apply_transposed(m: &Matrix, v: Vector) -> Vector {
    std::array::from_fn(|j| (0..3).map(|i| m[i][j] * v[i]).sum())
}

pub(super) fn product(a: &Matrix, b: &Matrix) -> Matrix {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()))
}

/// Two directions across `direction` and each other.
pub(super) fn tangents(direction: Vector) -> [Vector; 2] {
    let away = if direction[2].abs() > 0.7 { [1.0, 0.0, 0.0] } else { [0.0, 0.0, 1.0] };
    let first = unit(cross(direction, away));
    [first, cross(direction, first)]
}

/// The rotation about a vector by its length in radians (Rodrigues).
pub(super) fn exponential(v: Vector) -> Matrix {
    let angle = dot(v, v).sqrt();
    let (s, c) = if angle < 1e-8 { (1.0, 0.5) } else { (angle.sin() / angle, (1.0 - angle.cos()) / (angle * angle)) };
    let skew = [[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]];
    let squared = product(&skew, &skew);
    std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j)) + s * skew[i][j] + c * squared[i][j]))
}

/// Solves five equations by elimination with pivots; nothing if they are singular.
pub(super) fn solve(mut a: [[f64; 5]; 5], mut b: [f64; 5]) -> Option<[f64; 5]> {
    for k in 0..5 {
        let pivot = (k..5).max_by(|&i, &j| a[i][k].abs().total_cmp(&a[j][k].abs()))?;
        a.swap(k, pivot);
        b.swap(k, pivot);
        if a[k][k].abs() < 1e-18 || !a[k][k].is_finite() {
            return None;
        }
        for i in k + 1..5 {
            let factor = a[i][k] / a[k][k];
            let pivot = a[k];
            a[i].iter_mut().zip(pivot).skip(k).for_each(|(x, p)| *x -= factor * p);
            b[i] -= factor * b[k];
        }
    }
    for k in (0..5).rev() {
        let rest: f64 = (k + 1..5).map(|j| a[k][j] * b[j]).sum();
        b[k] = (b[k] - rest) / a[k][k];
    }
    Some(b)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rotations_turn_by_their_vectors_length() {
        for (vector, angle) in [([0.0; 3], 0.0), ([1e-9, 0.0, 0.0], 1e-9), ([0.3, -0.2, 0.1], 0.14f64.sqrt())] {
            let rotation = exponential(vector);
            assert!((degrees(&rotation).to_radians() - angle).abs() < 1e-12, "{vector:?}");
            for i in 0..3 {
                for j in 0..3 {
                    assert!((dot(rotation[i], rotation[j]) - f64::from(u8::from(i == j))).abs() < 1e-12);
                }
            }
        }
        // A quarter about y takes z to x.
        let quarter = exponential([0.0, std::f64::consts::FRAC_PI_2, 0.0]);
        assert!((apply(&quarter, [0.0, 0.0, 1.0])[0] - 1.0).abs() < 1e-12);
        assert!((apply_transposed(&quarter, [1.0, 0.0, 0.0])[2] - 1.0).abs() < 1e-12);
    }

    #[test]
    fn equations_are_solved_and_singular_ones_are_refused() {
        // Large off the diagonal: rows have to change places.
        let element = |i: usize, j: usize| if j == (i + 2) % 5 { 10.0 } else { ((i + 2 * j) % 3) as f64 };
        let a: [[f64; 5]; 5] = std::array::from_fn(|i| std::array::from_fn(|j| element(i, j)));
        let x = [1.0, -2.0, 0.5, 3.0, -1.0];
        let b = a.map(|row| row.iter().zip(&x).map(|(a, x)| a * x).sum());
        let found = solve(a, b).unwrap();
        assert!(found.iter().zip(&x).all(|(a, b)| (a - b).abs() < 1e-9), "{found:?}");
        assert_eq!(solve([[1.0; 5]; 5], [1.0; 5]), None);
    }
}
